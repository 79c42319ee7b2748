"""Heading error of the wheel odometry per distance, estimated against the matched scans."""

from __future__ import annotations

import math

import numpy as np

WINDOW_M = 2.0  # a measurement of the heading error covers this distance
MATCH_SIGMA_RAD = 0.003  # error of the matched turn over a window
# Before the first measurement: wheels that turn by a constant 0.6 degrees per metre, and a random turn of
# 0.6 degrees over a metre, which grows with the square root of the distance (floor joints, slip).
BIAS_RAD_PER_M, RANDOM_RAD2_PER_M = 0.01, 1e-4
BIAS_CHANGE_RAD_PER_M = 0.0001  # of the constant turn from window to window: load, tyre pressure, floor
PRIOR_WINDOWS, MEMORY_WINDOWS = 10, 300  # slips are rare: the random turn is the mean over a long drive
MAX_SAMPLE_RAD2_PER_M = 0.03  # of one window: a robot that was carried is no property of the wheels
SPEED_M_S = 0.5  # lowest estimate of the speed


class WheelHeadingError:
    """Heading error of the wheels per distance: a constant turn (Kalman filter) and a random one."""

    def __init__(self) -> None:
        self.turn_rad_per_m, self._bias_variance = 0.0, BIAS_RAD_PER_M**2  # turn that the wheels miss
        self._random = RANDOM_RAD2_PER_M
        self._windows = 0
        self.speed_m_s = SPEED_M_S
        self.restart()

    def restart(self) -> None:
        """Start a new window: the motion before it cannot be compared."""
        self._error_rad = self._distance_m = self._turned_rad = self._duration_s = 0.0

    def observe(self, error_rad: float, motion: np.ndarray, dt_s: float, scale_sigma: float) -> None:
        """Add the motion [3] between two scans by the scaled wheels.

        Args:
            error_rad: turn by the scans minus turn by the scaled wheels.
            dt_s: time between the scans.
            scale_sigma: standard deviation of the scale of turns.
        """
        self._error_rad += error_rad
        self._distance_m += math.hypot(motion[0], motion[1])
        self._turned_rad += motion[2]
        self._duration_s += dt_s
        d = self._distance_m
        if d < WINDOW_M:
            return
        noise = MATCH_SIGMA_RAD**2 + (scale_sigma * self._turned_rad) ** 2
        self._bias_variance += BIAS_CHANGE_RAD_PER_M**2
        error = self._error_rad / d - self.turn_rad_per_m
        sample = (error**2 - self._bias_variance) * d - noise / d
        self._windows += 1
        gain = 1.0 / min(self._windows + PRIOR_WINDOWS, MEMORY_WINDOWS)
        self._random += gain * (min(max(sample, 0.0), MAX_SAMPLE_RAD2_PER_M) - self._random)
        variance = self._random / d + noise / d**2
        weight = self._bias_variance / (self._bias_variance + variance)
        self.turn_rad_per_m += weight * error
        self._bias_variance *= 1.0 - weight
        if self._duration_s > 0.0:
            self.speed_m_s += 0.1 * (max(d / self._duration_s, SPEED_M_S) - self.speed_m_s)
        self.restart()

    def variance_rad2(self, distance_m: float) -> float:
        """Return the variance of the heading after a distance, corrected by `turn_rad_per_m`."""
        return self._bias_variance * distance_m**2 + self._random * distance_m
