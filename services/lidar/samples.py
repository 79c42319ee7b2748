"""Data types common to all lidars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Samples:
    """Consecutive measurements. Angles increase in the device's direction of rotation."""

    angle_deg: np.ndarray  # float64 [N]
    range_m: np.ndarray  # float64 [N], NaN = no valid measurement
    intensity: np.ndarray  # float64 [N]
    time_s: np.ndarray  # float64 [N] on the device's clock, increasing
    number: np.ndarray | None = None  # float64 [N]: sample numbers, including lost ones; None: unknown

    def __len__(self) -> int:
        return len(self.angle_deg)


@dataclass(frozen=True)
class LidarRevolution:
    """One revolution of a lidar on a regular grid of directions.

    Beam i is at angle_min_rad + i * angle_increment_rad and is measured i * time_increment_s after beam 0.
    """

    time_s: float  # of beam 0, on the device's clock
    angle_min_rad: float  # counter-clockwise from the device's front
    angle_increment_rad: float
    time_increment_s: float
    scan_time_s: float  # from beam 0 to beam 0 of the next revolution
    range_m: np.ndarray  # float32 [N], NaN = not measured
    intensity: np.ndarray  # float32 [N]


@dataclass(frozen=True)
class StampedScan:
    """A revolution with its stamp on the host's clock and the range limits of the device."""

    stamp_ns: int
    revolution: LidarRevolution
    range_min_m: float
    range_max_m: float
