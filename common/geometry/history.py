"""The last seconds of a drive: where the body was, and what the beams said, at the time of a picture."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from beamsplat.common.geometry.beams import NO_BEAMS, Beams, move_beams, scan_points
from beamsplat.common.geometry.transforms import interpolate, transform_points

EXTRAPOLATE_NS = 200_000_000  # a pose is continued this far along the last motion, no further
_GAP_NS = 2_000_000_000
BEAMS_WITHIN_NS = 150_000_000  # beams farther from a picture than this are not of its moment


@dataclass(frozen=True)
class TimedScan:
    """One revolution with its times; `moving` marks beams on people and carts, which are left out."""

    stamp_ns: int  # of the first beam
    angle_min_rad: float
    angle_increment_rad: float
    time_increment_s: float
    range_min_m: float
    range_max_m: float
    ranges_m: np.ndarray  # float32 [N]
    moving: np.ndarray | None = None  # bool [N]

    @classmethod
    def of(cls, scan: Any) -> TimedScan:
        """A Scan message's times and ranges."""
        return cls(
            scan.stamp_ns, scan.angle_min_rad, scan.angle_increment_rad, scan.time_increment_s,
            scan.range_min_m, scan.range_max_m, scan.ranges_m,
        )  # fmt: skip

    @property
    def last_ns(self) -> int:
        """Time of the last beam."""
        return self.stamp_ns + round(self.time_increment_s * 1e9 * max(len(self.ranges_m) - 1, 0))

    @property
    def middle_ns(self) -> int:
        """Halfway through the revolution."""
        return (self.stamp_ns + self.last_ns) // 2


class History:
    """Poses and scans of the last `keep_s` seconds, in a frame a in which the body moves smoothly."""

    def __init__(self, T_body_lidar: np.ndarray, keep_s: float = 5.0) -> None:
        self._T_body_lidar = T_body_lidar
        self._keep_ns = round(keep_s * 1e9)
        self._poses: deque[tuple[int, np.ndarray]] = deque()
        self._scans: deque[TimedScan] = deque()

    @property
    def newest_pose_ns(self) -> int:
        """Stamp of the newest pose; -1 before the first."""
        return self._poses[-1][0] if self._poses else -1

    def add_pose(self, stamp_ns: int, T_a_body: np.ndarray) -> None:
        """Takes a pose. One that is not newer than the last restarts the history (the clock was set); after a
        gap of seconds older poses are forgotten: a process may have started anew, with another frame."""
        if stamp_ns <= self.newest_pose_ns:
            self._poses.clear()
            self._scans.clear()
        if stamp_ns - self.newest_pose_ns > _GAP_NS:
            self._poses.clear()
        self._poses.append((stamp_ns, T_a_body))
        while stamp_ns - self._poses[0][0] > self._keep_ns:
            self._poses.popleft()

    def add_scan(self, scan: TimedScan) -> None:
        """Takes a scan."""
        self._scans.append(scan)
        while scan.stamp_ns - self._scans[0].stamp_ns > self._keep_ns:
            self._scans.popleft()

    def pose(self, stamp_ns: int) -> np.ndarray | None:
        """`T_a_body` [4, 4] at a stamp, interpolated, or continued for 0.2 s; None where it is not known."""
        if not self._poses or stamp_ns < self._poses[0][0]:
            return None
        before = self._poses[0]
        for after in self._poses:
            if after[0] >= stamp_ns:
                break
            before = after
        else:
            if stamp_ns - self._poses[-1][0] > EXTRAPOLATE_NS:
                return None
            if len(self._poses) == 1:
                return self._poses[0][1]
            before, after = self._poses[-2], self._poses[-1]
        if after[0] == before[0]:
            return after[1]
        return interpolate(before[1], after[1], (stamp_ns - before[0]) / (after[0] - before[0]))

    def scan_near(self, stamp_ns: int) -> TimedScan | None:
        """The scan whose middle is nearest to a stamp, if it is of that moment."""
        if not self._scans:
            return None
        scan = min(self._scans, key=lambda s: abs(s.middle_ns - stamp_ns))
        return scan if abs(scan.middle_ns - stamp_ns) <= BEAMS_WITHIN_NS else None

    def beams(self, stamp_ns: int) -> tuple[Beams, int]:
        """The nearest scan's returns, each moved to this stamp, and picture time minus scan time, ns."""
        scan = self.scan_near(stamp_ns)
        if scan is None:
            return NO_BEAMS, 0
        return self.beams_of(scan, stamp_ns), stamp_ns - scan.middle_ns

    def beams_of(self, scan: TimedScan, stamp_ns: int) -> Beams:
        """One scan's returns in the body frame of this stamp; none where a pose is missing."""
        points, index = scan_points(
            scan.ranges_m, scan.angle_min_rad, scan.angle_increment_rad, scan.range_min_m, scan.range_max_m
        )
        if scan.moving is not None and len(scan.moving) == len(scan.ranges_m):
            still = ~scan.moving[index]
            points, index = points[still], index[still]
        first, last, then = self.pose(scan.stamp_ns), self.pose(scan.last_ns), self.pose(stamp_ns)
        if first is None or last is None or then is None:
            return NO_BEAMS
        fraction = index / max(len(scan.ranges_m) - 1, 1)
        moved = move_beams(points, fraction, first, last, then, self._T_body_lidar)
        return Beams(moved, index, np.full(len(index), 0.01))

    def scan_points_a(self, scan: TimedScan) -> np.ndarray:
        """A scan's returns float64 [N, 3] in frame a."""
        T_a_body = self.pose(scan.middle_ns)
        if T_a_body is None:
            return np.zeros((0, 3))
        return transform_points(T_a_body, self.beams_of(scan, scan.middle_ns).points_body_m)
