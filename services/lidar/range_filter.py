"""Does not believe single ranges while the link is noisy.

A checksum of 8 bits (6 in SCIP) catches one wrong byte, but of packets with two or more it lets one in 256
(one in 64) through. On a clean link that is once in years; with one byte in a hundred wrong it is once in
seconds. While packets are seen to fail, a range must therefore be confirmed_ranges: by two neighbours on a
straight surface, or by the same direction one turn before.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

_WINDOW = 500  # packets looked back
_NOISY_RATIO = 0.02  # of them bad: at less, a doubly wrong packet passes about once in hours
_TOLERANCE_M = 0.02
_TOLERANCE_RATIO = 0.005  # of the range


class LinkNoise:
    """Whether packets fail often enough that the checksum alone cannot be trusted."""

    def __init__(self, always: bool = False) -> None:
        self._recent: deque[bool] = deque(maxlen=_WINDOW)
        self._bad = 0
        self._always = always  # for packets without a checksum

    def update(self, good: bool) -> None:
        """One more packet."""
        if len(self._recent) == self._recent.maxlen:
            self._bad -= not self._recent[0]
        self._recent.append(good)
        self._bad += not good

    @property
    def noisy(self) -> bool:
        """More than one packet in fifty failed lately (two failures at least)."""
        return self._always or self._bad >= max(2, math.ceil(_NOISY_RATIO * len(self._recent)))


def confirmed_ranges(
    range_m: np.ndarray,  # float64 [N] on a regular grid, NaN = none
    before_m: np.ndarray,  # float64 [N]: the same directions one turn before, NaN = none
) -> np.ndarray:
    """bool [N]: ranges that their neighbours or the turn before agree with, within 2 cm + 0.5 %.

    Along a straight wall 1/r is nearly linear in the angle: the two neighbours predict a range between them,
    and three in a row on one side, if they lie on a line themselves, the next.
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
    """Whether ranges are as predicted by their inverse, 1/m."""
    wanted_m = np.where(inverse > 0.0, 1.0 / inverse, np.nan)
    return np.abs(range_m - wanted_m) <= _tolerance_m(range_m)


def _shifted(values: np.ndarray, by: int) -> np.ndarray:
    """float64 [N]: values[i - by] at i; NaN beyond the ends."""
    found = np.full(len(values), np.nan)
    if by > 0:
        found[by:] = values[:-by]
    else:
        found[:by] = values[-by:]
    return found
