"""Standard deviation of a depth: of a pixel on the right surface, and with the gross errors on a wrong one.

A pixel is on a wrong surface with a probability that grows with the typical standard deviation s of its log
depth: s^2 / (s^2 + half^2). There its error is `size`. The variance of both cases together is

    stated^2 = s^2 + size^2 s^2 / (s^2 + half^2) + least^2.

Fusion states it. The mapper weights by s, because its robust losses bound the effect of gross errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Depth at which the lidar and the floor plane are the surface, too: low obstacles, table tops, open doors.
_LEAST_LOG = 0.018


@dataclass(frozen=True)
class GrossErrors:
    """Errors of pixels on a wrong surface, both of log depth."""

    size: float  # RMS of the error
    half: float  # typical standard deviation at which every second pixel is on a wrong surface


# Fitted to the RMS error by typical standard deviation on house_a and a simulated drive of seed 101;
# verified on other seeds by `bench uncertainties`.
OF_KEYFRAMES = GrossErrors(0.25, 0.12)
BETWEEN_KEYFRAMES = GrossErrors(0.33, 0.10)


def stated_sigma_log(typical: np.ndarray, gross: GrossErrors) -> np.ndarray:
    """Return the standard deviation of log depth with gross errors, float32; `typical` is that without."""
    s2 = np.square(typical, dtype=np.float64)
    share = s2 / (s2 + gross.half**2)
    return np.sqrt(s2 + gross.size**2 * share + _LEAST_LOG**2).astype(np.float32)


def typical_sigma_m(
    depth_m: np.ndarray,  # float32 [H, W], NaN = unknown
    stated_sigma_m: np.ndarray,  # float32 [H, W], NaN = unknown
) -> np.ndarray:
    """Return float32 [H, W] (m): the standard deviation without gross errors; inverse of `stated_sigma_log`.

    It is 0 where less is stated than any pixel has, and NaN where an input is NaN.
    """
    gross = OF_KEYFRAMES
    z = depth_m.astype(np.float64)
    a = np.maximum((stated_sigma_m / z) ** 2 - _LEAST_LOG**2, 0.0)
    # s^2 is the positive root of x^2 + b x - a half^2 = 0.
    b = gross.half**2 + gross.size**2 - a
    x = 2.0 * a * gross.half**2 / (b + np.sqrt(b**2 + 4.0 * a * gross.half**2))
    return (z * np.sqrt(x)).astype(np.float32)
