"""A robot that spins and drives in a simulated flat, and the lidar drivers of robots that people own.

The drivers are emulated by what they publish (their sources and issues are named at each): the same physical
sweeps, other fields. Those of the simulator's robots are in tools/simulator/lidar_drivers.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from beamsplat.common.scans.laser import LaserMessage
from beamsplat.tools.simulator.lidar_drivers import (
    LDLIDAR_STL_ROS2,
    SLLIDAR_ROS2,
    YDLIDAR_ROS2_DRIVER,
    RosLidarDriver,
    publish,
)
from tests.services.localization.world import WALLS, cast

START_NS = 1_767_225_600_000_000_000
PUBLISH_NS = 5_000_000  # from the last beam to the reception of the message


@dataclass(frozen=True)
class Drive:
    """True motion: straight parts and spins on the spot at `rate_rad_s`, x and y in the flat of world.py."""

    rate_rad_s: float = 1.0
    seconds: float = 16.0

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Return true poses float64 [N, 3] at the times t [N] (s)."""
        t = np.asarray(t, dtype=np.float64)
        steps = np.linspace(0.0, self.seconds + 1.0, 4001)
        # 1 s at rest, 2 s straight, a spin of 5 s to the left, 2 s straight, a spin to the right, straight.
        speed = np.where(((steps > 1) & (steps < 3)) | ((steps > 8) & (steps < 10)) | (steps > 15), 0.3, 0.0)
        rate = np.where((steps > 3) & (steps < 8), 1.0, np.where((steps > 10) & (steps < 15), -1.0, 0.0))
        dt = steps[1] - steps[0]
        smooth = np.hanning(101) / np.hanning(101).sum()
        speed, rate = (np.convolve(np.pad(v, 50, mode="edge"), smooth, "valid") for v in (speed, rate))
        yaw = 0.4 + np.cumsum(rate * self.rate_rad_s) * dt
        x, y = 1.6 + np.cumsum(speed * np.cos(yaw)) * dt, 1.8 + np.cumsum(speed * np.sin(yaw)) * dt
        return np.stack([np.interp(t, steps, v) for v in (x, y, yaw)], axis=1)


def odometry(drive: Drive, seed: int = 0) -> list[tuple[int, np.ndarray]]:
    """Return (stamp ns, pose_odom_body [3]) at 20 Hz, 2 % too long and 0.5 % too much turned."""
    t = np.arange(0.0, drive.seconds, 0.05)
    truth = drive(t)
    rng = np.random.default_rng(seed)
    poses = [np.zeros(3)]
    for before, after in pairwise(truth):
        length = np.hypot(*(after - before)[:2]) * 1.02 * (1.0 + 0.02 * rng.standard_normal())
        yaw = poses[-1][2] + 1.005 * (after - before)[2]
        middle = 0.5 * (yaw + poses[-1][2])
        poses.append(
            np.array([poses[-1][0] + length * np.cos(middle), poses[-1][1] + length * np.sin(middle), yaw])
        )
    return [(START_NS + round(s * 1e9), pose) for s, pose in zip(t, poses)]


def sweeps(
    drive: Drive,
    *,
    beams: int = 240,
    rate_hz: float = 10.0,
    clockwise: bool = False,
    at_once: bool = False,
    seed: int = 1,
    walls: np.ndarray = WALLS,
) -> list[LaserMessage]:
    """Return what an ideal driver publishes: counter-clockwise or clockwise revolutions, beams in order of time.

    A clockwise lidar is published with a negative angle_increment. The stamp is the time of the first beam.
    `walls`: segments float64 [N, 4] (x, y, x, y) in m.
    """
    rng = np.random.default_rng(seed)
    sign = -1.0 if clockwise else 1.0
    step = sign * 2.0 * np.pi / beams
    dt = 0.0 if at_once else 1.0 / rate_hz / beams
    found = []
    for k in range(int(drive.seconds * rate_hz) - 1):
        start = k / rate_hz
        poses = drive(start + dt * np.arange(beams))
        angles = -sign * np.pi + step * np.arange(beams)
        ranges = cast(poses[:, :2], poses[:, 2] + angles, walls) + 0.01 * rng.standard_normal(beams)
        ranges[rng.random(beams) < 0.01] = np.inf
        stamp = START_NS + round(start * 1e9)
        found.append(
            LaserMessage(
                at_ns=stamp + round(1e9 * dt * (beams - 1)) + PUBLISH_NS + int(rng.integers(0, 2_000_000)),
                stamp_ns=stamp, frame_id="laser", angle_min_rad=-sign * np.pi,
                angle_max_rad=-sign * np.pi + step * (beams - 1), angle_increment_rad=step,
                time_increment_s=dt, scan_time_s=1.0 / rate_hz, range_min_m=0.1, range_max_m=12.0,
                ranges_m=ranges.astype(np.float32), intensities=np.zeros(beams, np.float32),
            )
        )  # fmt: skip
    return found


def _reversed(m: LaserMessage) -> LaserMessage:
    """Order of a clockwise revolution by increasing angle; the sign of time_increment stays."""
    return replace(
        m, angle_min_rad=m.angle_max_rad, angle_max_rad=m.angle_min_rad, angle_increment_rad=-m.angle_increment_rad,
        ranges_m=m.ranges_m[::-1].copy(), intensities=m.intensities[::-1].copy(),
    )  # fmt: skip


# Slamtec/sllidar_ros2 (RPLIDAR A1, ...), ldrobotSensorTeam/ldlidar_stl_ros2 (LD06, LD19),
# YDLIDAR/ydlidar_ros2_driver (LIMO, ROSMASTER, JetRover). Directions are kept: the drivers' error of up to one
# beam is 0.3 to 0.8 degrees, but would be 2 degrees with the few beams of these tests.
sllidar_ros2 = partial(publish, replace(SLLIDAR_ROS2, closed=False))
ldlidar_stl_ros2 = partial(publish, replace(LDLIDAR_STL_ROS2, closed=False))
ydlidar_ros2_driver = partial(publish, replace(YDLIDAR_ROS2_DRIVER, closed=False))
# Of the TurtleBot3's lidars: LDS-02 (ROBOTIS-GIT/ld08_driver, whose angles vary) and LDS-03 (coin_d4_driver).
_TURTLEBOT3 = RosLidarDriver(
    reversed=True, no_return_m=0.0, stamps_publication=True, range_min_m=0.0, range_max_m=100.0
)
ld08_driver = partial(publish, replace(_TURTLEBOT3, lost_beams=(0, 1, 2)))


def coin_d4_driver(m: LaserMessage, k: int) -> LaserMessage:
    """ROBOTIS-GIT/coin_d4_driver: the last beam of the array is lost as well."""
    m = publish(_TURTLEBOT3, m, k)
    return replace(
        m, ranges_m=m.ranges_m[:-1].copy(), intensities=m.intensities[:-1].copy(),
        angle_max_rad=m.angle_max_rad - m.angle_increment_rad,
    )  # fmt: skip


def rplidar_mirrored(m: LaserMessage, k: int) -> LaserMessage:
    """frozenreboot/rplidar_driver #7: a clockwise lidar whose angles are published as counter-clockwise."""
    return replace(
        m,
        angle_min_rad=-m.angle_min_rad,
        angle_max_rad=-m.angle_max_rad,
        angle_increment_rad=-m.angle_increment_rad,
    )


def turtlebot3_slow(m: LaserMessage, k: int) -> LaserMessage:
    """ROBOTIS-GIT/turtlebot3 #634: time_increment is 20 times too small."""
    return replace(m, time_increment_s=m.time_increment_s / 20.0)


def eaibot(m: LaserMessage, k: int) -> LaserMessage:
    """EAIBOT/ydlidar #31: time_increment in nanoseconds, as a number of seconds."""
    return replace(m, time_increment_s=m.time_increment_s * 1e9, scan_time_s=m.scan_time_s * 1e9)


def negative_time(m: LaserMessage, k: int) -> LaserMessage:
    """SICKAG/sick_scan_xd #159: a negative time_increment, for beams that are in order."""
    return replace(m, time_increment_s=-m.time_increment_s)


def negative_time_true(m: LaserMessage, k: int) -> LaserMessage:
    """A clockwise lidar by increasing angle with the negative time_increment that it should then have."""
    m = _reversed(m)
    stamp = m.stamp_ns + round(1e9 * m.time_increment_s * (len(m.ranges_m) - 1))
    return replace(m, time_increment_s=-m.time_increment_s, stamp_ns=stamp)


def no_time(m: LaserMessage, k: int) -> LaserMessage:
    """A driver that leaves time_increment at 0, although its lidar turns."""
    return replace(m, time_increment_s=0.0)


DRIVERS: dict[str, Callable[[LaserMessage, int], LaserMessage]] = {
    "sllidar_ros2": sllidar_ros2,
    "ldlidar_stl_ros2": ldlidar_stl_ros2,
    "ld08_driver": ld08_driver,
    "coin_d4_driver": coin_d4_driver,
    "ydlidar_ros2_driver": ydlidar_ros2_driver,
    "rplidar_mirrored": rplidar_mirrored,
    "turtlebot3_slow": turtlebot3_slow,
    "eaibot": eaibot,
    "negative_time": negative_time,
    "negative_time_true": negative_time_true,
    "no_time": no_time,
}


def oradar_ms200(messages: list[LaserMessage]) -> list[LaserMessage]:
    """oradar_lidar (ORADAR MS200, Hiwonder and Yahboom robots): messages of 316 degrees, each of which starts
    where the one before it ended.
    """
    first = messages[0]
    ranges = np.concatenate([m.ranges_m for m in messages])
    size = round(len(first.ranges_m) * 316.0 / 360.0)
    found = []
    for k in range(len(ranges) // size):
        stamp = START_NS + round(k * size * first.time_increment_s * 1e9)
        angle = np.remainder(
            first.angle_min_rad + k * size * first.angle_increment_rad + np.pi, 2.0 * np.pi
        ) - np.pi  # fmt: skip
        found.append(
            replace(
                first, stamp_ns=stamp, at_ns=stamp + round(1e9 * size * first.time_increment_s) + PUBLISH_NS,
                angle_min_rad=float(angle), angle_max_rad=float(angle + (size - 1) * first.angle_increment_rad),
                ranges_m=ranges[k * size : (k + 1) * size], intensities=np.zeros(size, np.float32),
            )
        )  # fmt: skip
    return found
