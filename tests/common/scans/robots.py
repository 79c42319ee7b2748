"""A robot that spins and drives in a simulated flat, and the lidar drivers of robots that people own.

The drivers are emulated by what they publish (their sources and issues are named at each): the same physical
sweeps, other fields.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from beamsplat.common.scans.laser import LaserMessage
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
) -> list[LaserMessage]:
    """Return what an ideal driver publishes: counter-clockwise or clockwise revolutions, beams in order of time.

    A clockwise lidar is published with a negative angle_increment. The stamp is the time of the first beam.
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
        ranges = cast(poses[:, :2], poses[:, 2] + angles, WALLS) + 0.01 * rng.standard_normal(beams)
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


def _coded(m: LaserMessage, value: float) -> LaserMessage:
    """No return is published as `value`."""
    return replace(m, ranges_m=np.where(np.isinf(m.ranges_m), np.float32(value), m.ranges_m))


def sllidar_ros2(m: LaserMessage, k: int) -> LaserMessage:
    """Slamtec/sllidar_ros2 (RPLIDAR A1, ...): reversed beams with a positive time_increment, n - 1 steps."""
    m = _reversed(m)
    n = len(m.ranges_m)
    step = (m.angle_max_rad - m.angle_min_rad) / (n - 1)
    return replace(m, angle_increment_rad=step, range_min_m=0.15)


def ldlidar_stl_ros2(m: LaserMessage, k: int) -> LaserMessage:
    """ldrobotSensorTeam/ldlidar_stl_ros2 (LD06, LD19): as above, stamp = publication, NaN, range_max 25."""
    m = _coded(_reversed(m), np.nan)
    return replace(m, stamp_ns=m.at_ns - 1_000_000, range_max_m=25.0)


def ld08_driver(m: LaserMessage, k: int) -> LaserMessage:
    """ROBOTIS-GIT/ld08_driver (TurtleBot3 LDS-02): angles vary, 0.0 with range_min 0.0, range_max 100."""
    m = _coded(_reversed(m), 0.0)
    cut = k % 3
    m = replace(
        m, ranges_m=m.ranges_m[cut:].copy(), intensities=m.intensities[cut:].copy(),
        angle_min_rad=m.angle_min_rad + cut * m.angle_increment_rad,
    )  # fmt: skip
    return replace(m, range_min_m=0.0, range_max_m=100.0, stamp_ns=m.at_ns - 1_000_000)


def coin_d4_driver(m: LaserMessage, k: int) -> LaserMessage:
    """ROBOTIS-GIT/coin_d4_driver (TurtleBot3 LDS-03): stamp at publication, reversed, last beam lost, zeros."""
    m = _coded(_reversed(m), 0.0)
    m = replace(
        m, ranges_m=m.ranges_m[:-1].copy(), intensities=m.intensities[:-1].copy(),
        angle_max_rad=m.angle_max_rad - m.angle_increment_rad,
    )  # fmt: skip
    return replace(m, range_max_m=100.0, range_min_m=0.0, stamp_ns=m.at_ns - 1_000_000)


def ydlidar_ros2_driver(m: LaserMessage, k: int) -> LaserMessage:
    """YDLIDAR/ydlidar_ros2_driver (LIMO, ROSMASTER, JetRover): reverse time, zeros, range_max 64."""
    return replace(_coded(_reversed(m), 0.0), range_max_m=64.0, range_min_m=0.01)


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
    driver.__name__: driver
    for driver in (
        sllidar_ros2, ldlidar_stl_ros2, ld08_driver, coin_d4_driver, ydlidar_ros2_driver, rplidar_mirrored,
        turtlebot3_slow, eaibot, negative_time, negative_time_true, no_time,
    )
}  # fmt: skip
