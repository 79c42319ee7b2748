"""The robot's path: a smooth closed curve with a speed profile for a differential-drive robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from beamsplat.common.geometry.transforms import se2_to_se3


def resample_closed(points_m: np.ndarray, step_m: float) -> np.ndarray:
    """Return a closed polyline [N, 2] resampled at equal steps of at most `step_m` along its length.

    There are at least 8 points. The first point is not repeated at the end.
    """
    closed = np.vstack([points_m, points_m[:1]])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = max(8, int(np.ceil(s[-1] / step_m)))
    at = np.arange(count) * s[-1] / count
    return np.stack([np.interp(at, s, closed[:, k]) for k in range(2)], axis=1)


@dataclass(frozen=True)
class MotionLimits:
    """Upper limits of the robot's speed, turn rate, and acceleration along and across its path."""

    speed_m_s: float = 0.45
    turn_rad_s: float = 0.7
    acceleration_m_s2: float = 0.35
    lateral_m_s2: float = 0.25


class DrivePath:
    """The robot's pose as a function of time, on closed laps that start and end at rest in one place.

    The heading is the tangent of the curve, because a differential-drive robot cannot slide sideways.
    """

    def __init__(self, points_m: np.ndarray, limits: MotionLimits, *, start: float = 0.0) -> None:
        """Fit a closed curve through control points (x, y) [N, 2] and compute its speed profile.

        `start` is the control point where a lap begins, as a fraction 0..1 of all points.
        """
        count = len(points_m)
        points_m = np.roll(points_m, -int(start * count) % count, axis=0)
        closed = np.vstack([points_m, points_m[:1]])
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        self._curve = CubicSpline(length, closed, bc_type="periodic")
        self._s_end = float(length[-1])
        s = np.linspace(0.0, self._s_end, max(400, int(self._s_end / 0.005)))
        first, second = self._curve(s, 1), self._curve(s, 2)
        metric = np.linalg.norm(first, axis=1)
        curvature = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / metric**3
        along = np.concatenate([[0.0], np.cumsum(0.5 * (metric[1:] + metric[:-1]) * np.diff(s))])
        speed = np.minimum(limits.speed_m_s, limits.turn_rad_s / np.maximum(curvature, 1e-6))
        speed = np.minimum(speed, np.sqrt(limits.lateral_m_s2 / np.maximum(curvature, 1e-6)))
        speed = _limit_acceleration(speed, along, limits.acceleration_m_s2)
        time = np.concatenate([[0.0], np.cumsum(2 * np.diff(along) / (speed[1:] + speed[:-1]))])
        self.length_m = float(along[-1])
        # Between samples the acceleration is constant, so the position is a parabola: a cubic Hermite
        # segment represents it exactly.
        self._motion = CubicHermiteSpline(time, s, speed / metric)
        self._drive_s = float(time[-1])
        # A lap takes whole seconds: the period of every sensor divides it, so laps can share images.
        self.lap_s = float(np.ceil(time[-1] + 0.5))

    def pose_at(self, time_s: np.ndarray | float) -> np.ndarray:
        """Return pose_world_body (x, y, yaw) float64 [..., 3] at times in seconds since the drive start.

        Times beyond the first lap are allowed.
        """
        time = np.asarray(time_s, dtype=np.float64)
        s = self._position(time)
        xy, tangent = self._curve(s), self._curve(s, 1)
        return np.concatenate([xy, np.arctan2(tangent[..., 1], tangent[..., 0])[..., None]], axis=-1)

    def transform_at(self, time_s: np.ndarray | float) -> np.ndarray:
        """Return `T_world_body` float64 [..., 4, 4] at times in seconds since the start of the drive."""
        return se2_to_se3(self.pose_at(time_s))

    def _position(self, time: np.ndarray) -> np.ndarray:
        return self._motion(np.minimum(np.mod(time, self.lap_s), self._drive_s)) % self._s_end


def _limit_acceleration(speed: np.ndarray, along: np.ndarray, limit: float) -> np.ndarray:
    """Return the speed [N] in m/s, reduced so that acceleration and deceleration are within the limit.

    Args:
        speed: m/s at each sample; its array is not modified.
        along: arc length in metres at each sample.
        limit: largest acceleration in m/s^2. The returned speed at both ends is almost zero.
    """
    v2 = speed**2
    v2[0] = v2[-1] = 1e-5
    step = 2.0 * limit * np.diff(along)
    for k in range(1, len(v2)):
        v2[k] = min(v2[k], v2[k - 1] + step[k - 1])
    for k in range(len(v2) - 2, -1, -1):
        v2[k] = min(v2[k], v2[k + 1] + step[k])
    return np.sqrt(v2)
