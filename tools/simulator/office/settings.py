"""Settings that fully determine a simulated drive through an office floor."""

from __future__ import annotations

from dataclasses import dataclass, field

from beamsplat.tools.simulator.bag_layout import BagLayout
from beamsplat.tools.simulator.lidar_drivers import IDEAL, RosLidarDriver
from beamsplat.tools.simulator.path import MotionLimits
from beamsplat.tools.simulator.settings import LidarSettings, WheelSettings


@dataclass(frozen=True)
class OfficeSettings:
    """Settings of one recording of a drive through a generated office floor."""

    seed: int = 0
    length_m: float = 120.0  # along x
    width_m: float = 80.0  # along y
    distance_m: float = 3000.0  # driven distance; the last lap back to the start is added
    aliased: bool = False  # identical rooms along identical corridors
    lost: int = 0  # number of stretches without measurements
    lost_s: float = 30.0  # duration of each
    people: int = 0
    limits: MotionLimits = field(
        default_factory=lambda: MotionLimits(
            speed_m_s=1.0, turn_rad_s=0.9, acceleration_m_s2=0.5, lateral_m_s2=0.35
        )
    )
    lidar: LidarSettings = field(default_factory=lambda: LidarSettings(range_max_m=25.0, glass=True))
    # Each encoder reading costs time in the SLAM's input; 20 Hz is common for bases of service robots.
    wheels: WheelSettings = field(default_factory=lambda: WheelSettings(rate_hz=20.0))
    slips_per_km: float = 10.0  # of one wheel, for example at the edge of a carpet
    driver: RosLidarDriver = IDEAL
    layout: BagLayout = field(default_factory=BagLayout)
