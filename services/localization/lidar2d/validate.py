"""Validation of scans: malformed scans are rejected with a reason and do not affect the map."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.services.localization.lidar2d.scan import RawScan

RESTART_AFTER = 5  # rejected stamps in a row that increase, after which the clock is followed


class StampGuard:
    """Checks that stamps increase. If the clock was set back, the new time is accepted after a few scans."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        self._refused_ns: list[int] = []

    def check(self, stamp_ns: int) -> tuple[str, bool]:
        """Return why the stamp is rejected ("" if accepted), and whether it is accepted as a new time."""
        if self.last_ns is None or stamp_ns > self.last_ns:
            self.last_ns = stamp_ns
            self._refused_ns.clear()
            return "", False
        if self._refused_ns and stamp_ns <= self._refused_ns[-1]:
            self._refused_ns.clear()
        self._refused_ns.append(stamp_ns)
        if len(self._refused_ns) >= RESTART_AFTER:
            self._refused_ns.clear()
            self.last_ns = stamp_ns
            return "", True
        return f"stamp {stamp_ns} is not after the last one {self.last_ns}", False


def reason_to_reject(raw: RawScan) -> str:
    """Return the reason why a scan is malformed, "" if it is valid."""
    ranges = raw.ranges_m
    if not isinstance(ranges, np.ndarray) or ranges.ndim != 1 or ranges.dtype.kind != "f":
        return "ranges_m is not a one-dimensional float array"
    if len(ranges) == 0:
        return "ranges_m is empty"
    numbers = {
        "angle_min_rad": raw.angle_min_rad,
        "angle_increment_rad": raw.angle_increment_rad,
        "time_increment_s": raw.time_increment_s,
        "range_min_m": raw.range_min_m,
        "range_max_m": raw.range_max_m,
    }
    for name, value in numbers.items():
        if not math.isfinite(value):
            return f"{name} is {value}"
    if raw.angle_increment_rad == 0.0:
        return "angle_increment_rad is zero"
    if abs(raw.angle_increment_rad) * (len(ranges) - 1) > 2.0 * math.pi * 1.02:
        return f"{len(ranges)} beams of {raw.angle_increment_rad:.6f} rad are more than a revolution"
    if not 0.0 <= raw.range_min_m < raw.range_max_m:
        return f"range limits {raw.range_min_m} .. {raw.range_max_m} m are not increasing from zero"
    if not 0.0 <= raw.time_increment_s * len(ranges) <= 2.0:
        return f"time_increment_s {raw.time_increment_s} makes the scan last over 2 s or backwards"
    return ""
