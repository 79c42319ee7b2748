"""What a packet says, whatever the device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Samples:
    """Consecutive measurements. Angles are the device's own, growing in the order of measurement."""

    angle_deg: np.ndarray  # float64 [N]
    range_m: np.ndarray  # float64 [N], NaN = no valid measurement
    intensity: np.ndarray  # float64 [N]
    time_s: np.ndarray  # float64 [N] on the device's own clock, which only counts up
    number: np.ndarray | None = None  # float64 [N]: counts the measurements, lost ones too; None: not known

    def __len__(self) -> int:
        return len(self.angle_deg)


@dataclass(frozen=True)
class LidarRevolution:
    """One turn on a regular grid: beam i at angle_min + i * increment, i * time_increment after the first."""

    time_s: float  # of the first beam, on the device's clock
    angle_min_rad: float  # counter-clockwise from the device's front
    angle_increment_rad: float
    time_increment_s: float
    scan_time_s: float  # from this first beam to the next one's
    range_m: np.ndarray  # float32 [N], NaN = not measured
    intensity: np.ndarray  # float32 [N]


@dataclass(frozen=True)
class StampedScan:
    """A revolution with its time on the host's clock and the limits of its device."""

    stamp_ns: int
    revolution: LidarRevolution
    range_min_m: float
    range_max_m: float
