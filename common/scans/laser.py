"""A scan exactly as its driver published it, before anything is checked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

# Fields of a LaserScan that are single numbers, by their names in ROS.
NUMBERS = {
    "angle_min": "angle_min_rad",
    "angle_max": "angle_max_rad",
    "angle_increment": "angle_increment_rad",
    "time_increment": "time_increment_s",
    "scan_time": "scan_time_s",
    "range_min": "range_min_m",
    "range_max": "range_max_m",
}


@dataclass(frozen=True)
class LaserMessage:
    """One scan as published; the units in the names are those that the field should have."""

    at_ns: int  # time of reception
    stamp_ns: int
    frame_id: str
    angle_min_rad: float
    angle_max_rad: float
    angle_increment_rad: float
    time_increment_s: float
    scan_time_s: float
    range_min_m: float
    range_max_m: float
    ranges_m: np.ndarray  # float32 [N]
    intensities: np.ndarray  # float32 [M]
    echoes: int = 1  # largest number of echoes of a beam; of several, the first is used

    def with_numbers(self, **changes: float) -> LaserMessage:
        """Return a copy with other values of some fields."""
        return replace(self, **changes)  # type: ignore[arg-type]


def laser_of_ros(laser: Any, at_ns: int) -> LaserMessage:
    """Return a ROS LaserScan or MultiEchoLaserScan, received at `at_ns`."""
    ranges, intensities, echoes = laser.ranges, laser.intensities, 1
    if len(ranges) and hasattr(ranges[0], "echoes"):
        echoes = max(len(beam.echoes) for beam in ranges)
        ranges = np.array([beam.echoes[0] if len(beam.echoes) else np.nan for beam in ranges], np.float32)
        intensities = np.array(
            [beam.echoes[0] if len(beam.echoes) else 0.0 for beam in intensities], np.float32
        )
    stamp = laser.header.stamp
    numbers = {ours: float(getattr(laser, name)) for name, ours in NUMBERS.items()}
    return LaserMessage(
        at_ns=at_ns,
        stamp_ns=int(stamp.sec) * 10**9 + int(stamp.nanosec),
        frame_id=str(laser.header.frame_id),
        ranges_m=np.asarray(ranges, np.float32),
        intensities=np.asarray(intensities, np.float32),
        echoes=echoes,
        **numbers,
    )


def laser_of_fields(fields: dict[str, Any], at_ns: int) -> LaserMessage:
    """Return the fields of a `Scan` message (of a file or of our own drivers) as a LaserMessage."""
    ranges_m = np.asarray(fields["ranges_m"], np.float32)
    first, step = float(fields["angle_min_rad"]), float(fields["angle_increment_rad"])
    return LaserMessage(
        at_ns=at_ns,
        stamp_ns=int(fields["stamp_ns"]),
        frame_id="",
        angle_min_rad=first,
        angle_max_rad=first + step * max(len(ranges_m) - 1, 0),
        angle_increment_rad=step,
        time_increment_s=float(fields["time_increment_s"]),
        scan_time_s=float(fields["scan_time_s"]),
        range_min_m=float(fields["range_min_m"]),
        range_max_m=float(fields["range_max_m"]),
        ranges_m=ranges_m,
        intensities=np.asarray(fields.get("intensities", ()), np.float32),
    )
