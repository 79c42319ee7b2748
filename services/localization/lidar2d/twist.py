"""Body twists: logarithm and exponential of SE(2), and the error of a predicted twist."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.services.localization.lidar2d import se2

# Errors of a matched motion, which limit how well the twist over a scan interval is known.
MOTION_SIGMA_M, MOTION_SIGMA_RAD = 0.002, 0.004
MAX_SIGMA_M_S, MAX_SIGMA_RAD_S = 0.5, 2.0


class TwistErrorModel:
    """Standard deviations of the predicted twist during a scan, from the errors of the last scans.

    A predicted twist is compared with the motion to the next scan, not with the twist that was matched
    within the scan: a map of skewed scans confirms its own skew.
    """

    def __init__(self) -> None:
        self._variance_m = self._variance_rad = 0.0  # m^2/s^2, rad^2/s^2

    def sigmas(self, interval_s: float) -> tuple[float, float]:
        """Return the standard deviations (m/s, rad/s) of a twist over an interval."""
        return (
            min(math.sqrt(self._variance_m + (MOTION_SIGMA_M / interval_s) ** 2), MAX_SIGMA_M_S),
            min(math.sqrt(self._variance_rad + (MOTION_SIGMA_RAD / interval_s) ** 2), MAX_SIGMA_RAD_S),
        )

    def update(self, predicted: np.ndarray, measured: np.ndarray) -> None:
        """Update with a predicted twist [3] and that of the motion to the next scan, float64 [3]."""
        error = measured - predicted
        self._variance_m = _filter_variance(self._variance_m, float(error[0] ** 2 + error[1] ** 2) / 2.0)
        self._variance_rad = _filter_variance(self._variance_rad, float(error[2] ** 2))


def _filter_variance(value: float, sample: float) -> float:
    # An acceleration must count within a scan; it ends within a second.
    return value + (0.5 if sample > value else 0.1) * (sample - value)


def twist(motion: np.ndarray, dt_s: float) -> np.ndarray:
    """Return the constant body twist that moves by `motion` in `dt_s` (logarithm of SE(2))."""
    half = 0.5 * motion[2]
    ratio = 1.0 - half * half / 3.0 if abs(half) < 1e-3 else half / math.tan(half)
    vx = ratio * motion[0] + half * motion[1]
    vy = -half * motion[0] + ratio * motion[1]
    return np.array([vx, vy, motion[2]]) / dt_s


def exp_twist(velocity: np.ndarray, dt_s: float) -> np.ndarray:
    """Return the motion after `dt_s` at a constant body twist (exponential of SE(2))."""
    yaw = velocity[2] * dt_s
    half = 0.5 * yaw
    sinc = 1.0 - half * half / 6.0 if abs(half) < 1e-3 else math.sin(half) / half
    c, s = math.cos(half) * sinc, math.sin(half) * sinc
    return np.array(
        [
            (c * velocity[0] - s * velocity[1]) * dt_s,
            (s * velocity[0] + c * velocity[1]) * dt_s,
            se2.wrap(yaw),
        ]
    )
