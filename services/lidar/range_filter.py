"""Rejection of unconfirmed ranges while the link is noisy.

A checksum of 8 bits (6 in SCIP) detects one wrong byte, but accepts one in 256 (one in 64) packets with two
or more. On a clean link this happens once in years; with one wrong byte in a hundred, once in seconds. While
damaged packets are received, a range must therefore be confirmed: by two neighbours on a straight surface, or
by the same direction one revolution before.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

_WINDOW = 500  # packets over which failures are counted
_NOISY_RATIO = 0.02  # failed packets; below, an undetected damaged packet occurs about once in hours
_TOLERANCE_M = 0.02  # difference at which two ranges agree: this plus the next
_TOLERANCE_RATIO = 0.005  # of the range


class LinkNoise:
    """Detector of link noise: so many damaged packets that the checksum alone is not sufficient."""

    def __init__(self, always: bool = False) -> None:
        self._recent: deque[bool] = deque(maxlen=_WINDOW)
        self._bad = 0
        self._always = always  # for packets without a checksum

    def update(self, good: bool) -> None:
        """Count one packet; `good`: its checksum was correct."""
        if len(self._recent) == self._recent.maxlen:
            self._bad -= not self._recent[0]
        self._recent.append(good)
        self._bad += not good

    @property
    def noisy(self) -> bool:
        """Return whether more than 2 % of the recent packets, and at least two, were damaged."""
        return self._always or self._bad >= max(2, math.ceil(_NOISY_RATIO * len(self._recent)))


def confirmed_ranges(
    range_m: np.ndarray,  # float64 [N] on a regular grid, NaN = none
    before_m: np.ndarray,  # float64 [N]: the same directions one revolution before, NaN = none
) -> np.ndarray:
    """Return bool [N]: ranges that agree with neighbours or the revolution before, within 2 cm + 0.5 %.

    Along a straight wall 1/r is nearly linear in the angle: the two neighbours predict the range between
    them, and three collinear points on one side predict the next.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / range_m
        between = _matches_inverse(range_m, 0.5 * (_shifted(inverse, 1) + _shifted(inverse, -1)))
        agrees = between | (np.abs(range_m - before_m) <= _tolerance_m(range_m))
        for side in (1, -1):
            ahead = 2.0 * _shifted(inverse, side) - _shifted(inverse, 2 * side)
            in_line = _shifted(between, 2 * side) == 1.0
            agrees |= _matches_inverse(range_m, ahead) & in_line
    return agrees


def _tolerance_m(range_m: np.ndarray) -> np.ndarray:
    return _TOLERANCE_M + _TOLERANCE_RATIO * range_m


def _matches_inverse(range_m: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Return bool [N]: whether ranges (m) agree with the predicted inverse ranges (1/m)."""
    wanted_m = np.where(inverse > 0.0, 1.0 / inverse, np.nan)
    return np.abs(range_m - wanted_m) <= _tolerance_m(range_m)


def _shifted(values: np.ndarray, by: int) -> np.ndarray:
    """Return float64 [N] with values[i - by] at i; NaN beyond the ends."""
    found = np.full(len(values), np.nan)
    if by > 0:
        found[by:] = values[:-by]
    else:
        found[:by] = values[-by:]
    return found
