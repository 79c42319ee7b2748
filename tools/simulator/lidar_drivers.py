"""What the ROS drivers of lidars make of a revolution: order, directions, times, codes, limits of the beams.

A driver is data (`RosLidarDriver`); `publish` applies it to the message of an ideal driver.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from beamsplat.common.scans.laser import LaserMessage

_PUBLISH_NS = 1_000_000  # from the stamp of a driver that stamps the publication, to the reception


@dataclass(frozen=True)
class SectorFilter:
    """Removes the returns in a sector: an option of a driver, or a node of the package laser_filters."""

    first_rad: float  # as published, in the lidar frame
    last_rad: float
    beyond: bool = False  # they become range_max + 1 m (LaserScanAngularBoundsFilterInPlace) instead of NaN

    def apply(self, m: LaserMessage) -> LaserMessage:
        """Return the message without the returns in the sector."""
        angles = m.angle_min_rad + m.angle_increment_rad * np.arange(len(m.ranges_m))
        inside = (angles >= self.first_rad) & (angles <= self.last_rad)
        removed = np.float32(m.range_max_m + 1.0 if self.beyond else np.nan)
        return replace(m, ranges_m=np.where(inside, removed, m.ranges_m))


@dataclass(frozen=True)
class RosLidarDriver:
    """How a driver publishes a revolution. The defaults are those of an ideal driver, which changes nothing.

    An ideal message has its beams in the order of measurement, +inf for no return, and the stamp of the first
    beam; a lidar that turns clockwise has a negative angle_increment.
    """

    reversed: bool = False  # beams in the opposite order, although time_increment stays positive
    closed: bool = False  # n beams over 2 pi / (n - 1) each: the last has the direction of the first
    copies: int = 1  # a reading is also published for the next copies - 1 beams, if these have none
    no_return_m: float = math.inf  # published for beams without a return
    stamps_publication: bool = False  # the stamp is the time of publication, after the last beam
    lost_beams: tuple[int, ...] = (0,)  # number of last beams that are lost, of one revolution after another
    range_min_m: float | None = None  # None: of the lidar
    range_max_m: float | None = None
    crop: SectorFilter | None = None


IDEAL = RosLidarDriver()
# Slamtec/sllidar_ros2 and rplidar_ros; `copies` (angle_compensate) depends on the mode of the lidar.
SLLIDAR_ROS2 = RosLidarDriver(reversed=True, closed=True, range_min_m=0.15)
# ldrobotSensorTeam/ldlidar_stl_ros2; the number of points differs from revolution to revolution.
LDLIDAR_STL_ROS2 = RosLidarDriver(
    reversed=True, closed=True, no_return_m=math.nan, stamps_publication=True, lost_beams=(0, 1, 2),
    range_min_m=0.02, range_max_m=25.0,
)  # fmt: skip
# YDLIDAR/ydlidar_ros2_driver; invalid_range_is_inf is read but never used.
YDLIDAR_ROS2_DRIVER = RosLidarDriver(
    reversed=True, closed=True, no_return_m=0.0, range_min_m=0.1, range_max_m=64.0
)


def publish(driver: RosLidarDriver, ideal: LaserMessage, number: int) -> LaserMessage:
    """Return what `driver` publishes of revolution `number`, of which an ideal driver publishes `ideal`."""
    m = _without_last(ideal, driver.lost_beams[number % len(driver.lost_beams)])
    ranges = _copied(m.ranges_m, driver.copies) if driver.copies > 1 else m.ranges_m
    m = replace(m, ranges_m=np.where(np.isinf(ranges), np.float32(driver.no_return_m), ranges))
    if driver.closed:
        m = _closed(m, np.float32(driver.no_return_m))
    if driver.reversed:
        m = replace(
            m, angle_min_rad=m.angle_max_rad, angle_max_rad=m.angle_min_rad,
            angle_increment_rad=-m.angle_increment_rad, ranges_m=m.ranges_m[::-1].copy(),
            intensities=m.intensities[::-1].copy(),
        )  # fmt: skip
    if driver.stamps_publication:
        m = replace(m, stamp_ns=m.at_ns - _PUBLISH_NS)
    m = replace(
        m, range_min_m=m.range_min_m if driver.range_min_m is None else driver.range_min_m,
        range_max_m=m.range_max_m if driver.range_max_m is None else driver.range_max_m,
    )  # fmt: skip
    return m if driver.crop is None else driver.crop.apply(m)


def _without_last(m: LaserMessage, count: int) -> LaserMessage:
    """Return the message without its last `count` beams."""
    n = len(m.ranges_m) - count
    return replace(
        m, ranges_m=m.ranges_m[:n], intensities=m.intensities[:n],
        angle_max_rad=m.angle_max_rad - count * m.angle_increment_rad,
    )  # fmt: skip


def _copied(ranges_m: np.ndarray, copies: int) -> np.ndarray:
    """Return ranges [N] in which a beam without a return has the reading of up to copies - 1 beams before."""
    found = ranges_m.copy()
    for offset in range(1, copies):
        earlier = np.concatenate([np.full(offset, np.inf, found.dtype), ranges_m[:-offset]])
        found = np.where(np.isinf(found), earlier, found)
    return found


def _closed(m: LaserMessage, no_return_m: np.float32) -> LaserMessage:
    """Return the message with its n beams on n directions from the first to a whole turn later.

    A beam goes to the next direction; of two beams for one direction, the nearer return is kept.
    """
    n = len(m.ranges_m)
    step = math.copysign(2.0 * math.pi / (n - 1), m.angle_increment_rad)
    at = np.ceil(np.arange(n) * (m.angle_increment_rad / step) - 1e-9).astype(int)
    ranges = np.full(n, no_return_m, np.float32)
    valid = np.flatnonzero(np.isfinite(m.ranges_m) & (m.ranges_m > 0.0) & (at < n))
    nearest = np.full(n, np.inf, np.float32)
    np.minimum.at(nearest, at[valid], m.ranges_m[valid])
    ranges[np.isfinite(nearest)] = nearest[np.isfinite(nearest)]
    return replace(
        m, angle_max_rad=m.angle_min_rad + (n - 1) * step, angle_increment_rad=step, ranges_m=ranges,
        time_increment_s=m.time_increment_s * len(m.ranges_m) / (n - 1),
    )  # fmt: skip
