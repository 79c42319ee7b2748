"""Does not believe single ranges while the link is noisy.

A checksum of 8 bits (6 in SCIP) catches one wrong byte, but of packets with two or more it lets one in 256
(one in 64) through. On a clean link that is once in years; with one byte in a hundred wrong it is once in
seconds. While packets are seen to fail, a range must therefore be confirmed: by two neighbours on a
straight surface, or by the same direction one turn before.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

_WINDOW = 500  # packets looked back
_NOISY_SHARE = 0.02  # of them bad: at less, a doubly wrong packet passes about once in hours
_TOLERANCE_M = 0.02
_TOLERANCE = 0.005  # of the range


class LinkNoise:
    """Whether packets fail often enough that the checksum alone cannot be trusted."""

    def __init__(self, always: bool = False) -> None:
        self._recent: deque[bool] = deque(maxlen=_WINDOW)
        self._bad = 0
        self._always = always  # for packets without a checksum

    def saw(self, good: bool) -> None:
        """One more packet."""
        if len(self._recent) == self._recent.maxlen:
            self._bad -= not self._recent[0]
        self._recent.append(good)
        self._bad += not good

    @property
    def noisy(self) -> bool:
        """More than one packet in fifty failed lately (two failures at least)."""
        return self._always or self._bad >= max(2, math.ceil(_NOISY_SHARE * len(self._recent)))


def confirmed(
    range_m: np.ndarray,  # float64 [N] on a regular grid, NaN = none
    before_m: np.ndarray,  # float64 [N]: the same directions one turn before, NaN = none
) -> np.ndarray:
    """bool [N]: ranges that two neighbours or the turn before agree with, within 2 cm + 0.5 %.

    Along a straight wall 1/r is nearly linear in the angle, so that neighbours predict a range.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / range_m
        padded = np.concatenate([np.full(2, np.nan), inverse, np.full(2, np.nan)])
        left2, left, right, right2 = padded[:-4], padded[1:-3], padded[3:-1], padded[4:]
        predictions = (0.5 * (left + right), 2.0 * left - left2, 2.0 * right - right2)
        agrees = np.abs(range_m - before_m) <= _TOLERANCE_M + _TOLERANCE * range_m
        for prediction in predictions:
            wanted = np.where(prediction > 0.0, 1.0 / prediction, np.nan)
            agrees |= np.abs(range_m - wanted) <= _TOLERANCE_M + _TOLERANCE * range_m
    return agrees
