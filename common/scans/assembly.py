"""Assembly of whole revolutions from messages that each hold a part of one."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

_MIN_MESSAGES = 6  # to recognise parts of revolutions
_GAP_BEAMS = 3.5  # between the end of a part and the start of the next
_FULL_RAD = math.radians(345.0)  # a message of more is a whole revolution
_SECTOR = 0.6  # a message whose valid beams fill less of it may be a sector
_MAX_BEAMS = 65536


def are_parts(fields: list[dict[str, Any]]) -> bool:
    """Return whether consecutive scans (fields of `Scan`) continue each other around the lidar.

    A scan that starts where the one before it ended, at another angle, is a part of a revolution.
    """
    if len(fields) < _MIN_MESSAGES:
        return False
    follows = 0
    for before, after in pairwise(fields):
        step = before["angle_increment_rad"]
        if abs(step) * len(before["ranges_m"]) > _FULL_RAD or step * after["angle_increment_rad"] <= 0.0:
            return False
        moved = math.remainder(after["angle_min_rad"] - before["angle_min_rad"], 2.0 * math.pi)
        follows += abs(moved) > 2.0 * abs(step) and abs(_gap_beams(before, after)) <= _GAP_BEAMS
    return follows >= 0.7 * (len(fields) - 1)


def are_sectors(fields: list[dict[str, Any]]) -> bool:
    """Return whether the scans have one grid of directions, of which each has measured another sector."""
    if len(fields) < _MIN_MESSAGES or len({len(scan["ranges_m"]) for scan in fields}) > 1:
        return False
    if max(scan["angle_min_rad"] for scan in fields) - min(scan["angle_min_rad"] for scan in fields) > 0.01:
        return False
    masks = np.array([_valid(scan) for scan in fields])
    if masks.mean() > _SECTOR or masks.sum(axis=1).min() < 3:
        return False
    overlap = np.mean([(a & b).sum() / max(min(a.sum(), b.sum()), 1) for a, b in pairwise(masks)])
    return bool(overlap < 0.25 and masks.any(axis=0).mean() > 1.5 * masks.mean())


def _valid(scan: dict[str, Any]) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return (scan["ranges_m"] > scan["range_min_m"]) & (scan["ranges_m"] < scan["range_max_m"])


def sector_of(scan: dict[str, Any]) -> dict[str, Any] | None:
    """Return the measured sector of a scan on a fixed grid: the beams from the first valid to the last.

    On a grid of a whole revolution, a sector may extend over its end.
    """
    valid = np.flatnonzero(_valid(scan))
    n = len(scan["ranges_m"])
    if len(valid) < 3:
        return None
    gaps = np.diff(valid, append=valid[0] + n)
    widest = int(gaps.argmax())  # the sector starts after the widest gap, seen around the circle
    start = int(valid[(widest + 1) % len(valid)])
    size = n - int(gaps[widest]) + 1
    index = (start + np.arange(size)) % n
    if start + size > n and abs(scan["angle_increment_rad"]) * n < _FULL_RAD:
        index, start = np.arange(valid[0], valid[-1] + 1), int(valid[0])
    found = dict(scan)
    found["angle_min_rad"] = scan["angle_min_rad"] + start * scan["angle_increment_rad"]
    found["ranges_m"] = scan["ranges_m"][index]
    found["intensities"] = (
        scan["intensities"][index] if len(scan["intensities"]) == n else np.zeros(0, np.float32)
    )
    return found


def _gap_beams(before: dict[str, Any], after: dict[str, Any]) -> float:
    """Return the number of beams missing between the end of a part and the start of the next."""
    step = before["angle_increment_rad"]
    expected = before["angle_min_rad"] + step * len(before["ranges_m"])
    return math.remainder(after["angle_min_rad"] - expected, 2.0 * math.pi) / step


class TurnAssembler:
    """Joins parts of revolutions; `add` returns a scan whenever a whole revolution is complete."""

    def __init__(self, *, sectors: bool = False) -> None:
        """`sectors`: the scans have a fixed grid, of which each has measured a sector (see `are_sectors`)."""
        self.sectors = sectors
        self._scans: list[dict[str, Any]] = []
        self._times_ns: list[np.ndarray] = []
        self._ranges: list[np.ndarray] = []
        self.interrupted = 0  # parts that were dropped, because the next one is missing

    def add(self, scan: dict[str, Any]) -> dict[str, Any] | None:
        """Add a part (fields of `Scan`); return the fields of a whole revolution if it completes one."""
        part = sector_of(scan) if self.sectors else scan
        if part is None:
            return None
        step = part["angle_increment_rad"]
        if self._scans:
            last = self._scans[-1]
            gap = _gap_beams(last, part) if step * last["angle_increment_rad"] > 0.0 else math.inf
            late = part["stamp_ns"] - last["stamp_ns"] > 1_000_000_000 or part["stamp_ns"] <= last["stamp_ns"]
            if abs(gap) > _GAP_BEAMS * (4.0 if self.sectors else 1.0) or late:
                self.interrupted += len(self._scans)
                self._reset()
            else:
                self._fill(max(round(gap), 0))
        self._scans.append(part)
        n = len(part["ranges_m"])
        self._times_ns.append(part["stamp_ns"] + 1e9 * part["time_increment_s"] * np.arange(n))
        self._ranges.append(np.asarray(part["ranges_m"], np.float32))
        return self._revolution(part)

    def _fill(self, missing: int) -> None:
        if missing:
            self._times_ns.append(np.full(missing, np.nan))
            self._ranges.append(np.full(missing, np.nan, np.float32))

    def _reset(self) -> None:
        self._scans, self._times_ns, self._ranges = [], [], []

    def _revolution(self, newest: dict[str, Any]) -> dict[str, Any] | None:
        first = self._scans[0]
        step = first["angle_increment_rad"]
        full = round(2.0 * math.pi / abs(step))
        ranges = np.concatenate(self._ranges)
        if len(ranges) < full or not 3 <= full <= _MAX_BEAMS:
            return None
        start_ns = first["stamp_ns"]
        times = np.concatenate([t - start_ns for t in self._times_ns])
        index = np.arange(len(times))
        known = np.isfinite(times)
        times = np.interp(index, index[known], times[known])
        found = dict(first)
        found["ranges_m"] = ranges[:full].copy()
        found["intensities"] = np.zeros(0, np.float32)
        # Parts without a time per beam are each at one time; over the whole turn, the time advances evenly.
        slope = np.polyfit(index[:full], times[:full], 1)[0] if full > 1 else 0.0
        found["time_increment_s"] = max(float(slope), 0.0) / 1e9
        found["scan_time_s"] = found["time_increment_s"] * full
        # What is beyond the revolution starts the next one.
        rest = len(ranges) - full
        self._reset()
        if 0 < rest < len(newest["ranges_m"]):
            n = len(newest["ranges_m"])
            part = dict(newest)
            part["angle_min_rad"] = newest["angle_min_rad"] + (n - rest) * newest["angle_increment_rad"]
            part["stamp_ns"] = newest["stamp_ns"] + round(1e9 * (n - rest) * newest["time_increment_s"])
            part["ranges_m"] = newest["ranges_m"][n - rest :]
            self._scans = [part]
            self._times_ns = [part["stamp_ns"] + 1e9 * part["time_increment_s"] * np.arange(rest)]
            self._ranges = [np.asarray(part["ranges_m"], np.float32)]
        return found
