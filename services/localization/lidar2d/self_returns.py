"""Returns on the robot's own body: posts and mounts in the plane of the lidar, found by their constant range.

A surface of the robot stays at a constant range at its angle while the robot drives and turns. A wall that is
followed does so only while the robot drives straight, a round pillar only while it turns around it; therefore
both motions are required, and turns in both directions or a half turn.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from beamsplat.services.localization.lidar2d.scan import RawScan

BINS = 1440  # of a quarter of a degree: the angles of beams differ from scan to scan with some lidars
MAX_RANGE_M = 1.0  # the body of a robot with a planar lidar ends nearer
TOLERANCE_M = 0.04  # noise of near returns of low-cost lidars
REMOVED_M = 0.06  # returns within this distance of a surface of the robot are removed
EDGE_BINS = 2  # on either side of a surface: returns at its edge
MIN_RETURNS = 20
MAX_OTHER_RATIO = 0.05  # of the returns at another range
MIN_STRAIGHT_M, STRAIGHT_RAD_PER_M = 0.5, 0.3
MIN_TURN_RAD, MIN_TURNS_RAD = math.radians(30.0), math.radians(180.0)
STANDSTILL_M, STANDSTILL_RAD = 0.005, 0.005  # a motion between two scans below both tells nothing
SECTOR_GAP_BINS = 8  # bins nearer to each other belong to the same part of the robot


@dataclasses.dataclass(frozen=True)
class Sector:
    """A part of the robot that the lidar sees, in the frame of the lidar."""

    first_rad: float
    last_rad: float
    range_m: float  # the nearest

    def text(self) -> str:
        """Return the sector in words."""
        first, last = math.degrees(self.first_rad), math.degrees(self.last_rad)
        return f"{first:.0f} to {last:.0f} deg at {self.range_m:.2f} m"


def sectors_text(sectors: list[Sector]) -> str:
    """Return sectors in words, "" if there is none."""
    parts = ", ".join(sector.text() for sector in sectors)
    return f"the lidar sees the robot itself; these returns are removed: {parts}" if parts else ""


class SelfReturns:
    """Finds and removes the returns on the robot's own body, by angle in the frame of the lidar."""

    def __init__(self) -> None:
        self.range_m = np.full(BINS, np.nan)  # of the robot's own surface, NaN: none
        self.removed = 0  # returns in all scans
        self._near, self._far = np.full(BINS, np.inf), np.full(BINS, -np.inf)  # what is removed
        self._reference_m = np.full(BINS, np.nan)
        self._same, self._other = np.zeros(BINS), np.zeros(BINS)
        # Straight distance (m), turns to the left and to the right (rad): in all, and where a bin began.
        self._driven = np.zeros(3)
        self._since = np.zeros((BINS, 3))

    def without(self, raw: RawScan) -> RawScan:
        """Return the scan without its returns on the robot."""
        if not np.isfinite(self.range_m).any():
            return raw
        bins = _bins(raw)
        own = (raw.ranges_m >= self._near[bins]) & (raw.ranges_m <= self._far[bins])
        if not own.any():
            return raw
        self.removed += int(own.sum())
        return dataclasses.replace(raw, ranges_m=np.where(own, np.inf, raw.ranges_m).astype(np.float32))

    def observe(self, raw: RawScan, motion: np.ndarray) -> bool:
        """Compare a scan with those before it; return whether a new surface of the robot was found.

        Args:
            raw: the scan with all its returns.
            motion: float64 [3], matched motion of the body since the last scan.
        """
        distance, turn = math.hypot(motion[0], motion[1]), float(motion[2])
        if distance < STANDSTILL_M and abs(turn) < STANDSTILL_RAD:
            return False
        straight = distance if abs(turn) < STRAIGHT_RAD_PER_M * distance else 0.0
        self._driven += (straight, max(turn, 0.0), max(-turn, 0.0))
        ranges = np.asarray(raw.ranges_m, dtype=np.float64)
        valid = (ranges >= raw.range_min_m) & (ranges < raw.range_max_m) & (ranges > 0.0)
        seen_m = np.full(BINS, np.nan)
        seen_m[_bins(raw)[valid]] = ranges[valid]
        with np.errstate(invalid="ignore"):
            same = np.abs(seen_m - self._reference_m) <= TOLERANCE_M
            other = np.isfinite(seen_m) & np.isfinite(self._reference_m) & ~same
        self._same += same
        self._other += other
        gain = 1.0 / np.minimum(self._same[same], 50.0)
        self._reference_m[same] += gain * (seen_m[same] - self._reference_m[same])
        refuted = self._other > MAX_OTHER_RATIO * self._same + 1.0
        start = (refuted | ~np.isfinite(self._reference_m)) & np.isfinite(seen_m)
        self._reference_m[start] = np.where(seen_m[start] < MAX_RANGE_M, seen_m[start], np.nan)
        self._same[start], self._other[start], self._since[start] = 0.0, 0.0, self._driven
        straight_m, left, right = (self._driven - self._since).T
        turned = ((left >= MIN_TURN_RAD) & (right >= MIN_TURN_RAD)) | (left + right >= MIN_TURNS_RAD)
        found = (self._same >= MIN_RETURNS) & (straight_m >= MIN_STRAIGHT_M) & turned
        new = found & ~np.isfinite(self.range_m)
        if new.any():
            self.range_m[new] = self._reference_m[new]
            self._update_limits()
        return bool(new.any())

    def restore(self, range_m: np.ndarray) -> None:
        """Continue with the surfaces found in an earlier run.

        Args:
            range_m: float [BINS], NaN where there is no surface of the robot.

        Raises:
            ValueError: the array has another shape.
        """
        if range_m.shape != (BINS,):
            raise ValueError(f"self_returns has shape {range_m.shape}, expected ({BINS},)")
        self.range_m = range_m.astype(np.float64)
        self._update_limits()

    def sectors(self) -> list[Sector]:
        """Return the parts of the robot that were found, by angle."""
        bins = np.flatnonzero(np.isfinite(self.range_m))
        if not len(bins):
            return []
        parts = np.split(bins, np.flatnonzero(np.diff(bins) > SECTOR_GAP_BINS) + 1)
        if len(parts) > 1 and parts[0][0] + BINS - parts[-1][-1] <= SECTOR_GAP_BINS:
            parts = [np.concatenate([parts[-1], parts[0] + BINS]), *parts[1:-1]]
        return [
            Sector(_angle(part[0]), _angle(part[-1]), float(self.range_m[part % BINS].min()))
            for part in parts
        ]

    def text(self) -> str:
        """Return what was found in words, "" if nothing."""
        return sectors_text(self.sectors())

    def _update_limits(self) -> None:
        """Compute the ranges that are removed; a surface extends a little beyond its found bins."""
        near, far = np.full(BINS, np.inf), np.full(BINS, -np.inf)
        found = np.isfinite(self.range_m)
        for shift in range(-EDGE_BINS, EDGE_BINS + 1):
            shifted = np.roll(found, shift)
            range_m = np.roll(self.range_m, shift)[shifted]
            near[shifted] = np.minimum(near[shifted], range_m - REMOVED_M)
            far[shifted] = np.maximum(far[shifted], range_m + REMOVED_M)
        self._near, self._far = near, far


def _bins(raw: RawScan) -> np.ndarray:
    """Return the bin of each beam, int64 [N]."""
    angles = raw.angle_min_rad + raw.angle_increment_rad * np.arange(len(raw.ranges_m))
    return np.rint(angles * (BINS / (2.0 * np.pi))).astype(np.int64) % BINS


def _angle(bin_number: int) -> float:
    """Return the angle of a bin in -pi .. pi."""
    return float(math.remainder(bin_number * 2.0 * np.pi / BINS, 2.0 * np.pi))
