"""How a camera sees, from pictures of a chessboard: focal lengths, centre, distortion, with their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from beamsplat.tools.setup.pattern import Board

VIEWS = 12
_FIND_WIDTH_PX = 960  # corners are looked for in a picture so wide, and refined in the whole one
_NEW = 0.05  # of the picture's width: corners must lie so far from all earlier ones on the average
_GOOD_RMS_PX = 1.0
_GROUPS = 3
_FEWEST = 6


@dataclass(frozen=True)
class Lens:
    """K and distortion (plumb bob) with standard errors, and how well the corners fit."""

    size_px: tuple[int, int]  # width, height
    K: np.ndarray  # float64 [3, 3]
    distortion: np.ndarray  # float64 [5]
    focal_sigma_px: float
    rms_px: float  # reprojection error over all corners
    views: int

    @property
    def good(self) -> bool:
        """Whether it may be used."""
        return self.rms_px < _GOOD_RMS_PX and self.focal_sigma_px < 0.02 * self.K[0, 0]


class LensCalibration:
    """Takes pictures; keeps those that show the board where it has not been yet."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._grid = np.zeros((board.corners[0] * board.corners[1], 3), np.float32)
        self._grid[:, :2] = np.mgrid[: board.corners[0], : board.corners[1]].T.reshape(-1, 2) * board.square_m
        self.views: list[np.ndarray] = []  # float32 [N, 2] corners of each
        self._size_px: tuple[int, int] | None = None

    def add(self, grey: np.ndarray) -> str:
        """Looks at a picture, uint8 [H, W]: "taken", "no board", or "too alike"; all must be of one size."""
        self._size_px = grey.shape[1], grey.shape[0]
        uv = self._corners(grey)
        if uv is None:
            return "no board"
        # A board turned by half is the same board: its corners come in the other order.
        far = _NEW * grey.shape[1]
        for other in self.views:
            if min(np.abs(uv - other).mean(), np.abs(uv[::-1] - other).mean()) < far:
                return "too alike"
        self.views.append(uv)
        return "taken"

    def _corners(self, grey: np.ndarray) -> np.ndarray | None:
        shrink = min(_FIND_WIDTH_PX / grey.shape[1], 1.0)
        small = (
            grey
            if shrink == 1.0
            else cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        )
        found, uv = cv2.findChessboardCornersSB(small, self._board.corners, flags=cv2.CALIB_CB_ACCURACY)
        if not found:
            return None
        uv = (uv.reshape(-1, 2).astype(np.float32) + 0.5) / shrink - 0.5
        if shrink < 1.0:
            criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)
            uv = cv2.cornerSubPix(grey, np.ascontiguousarray(uv), (5, 5), (-1, -1), criteria)
        return uv.reshape(-1, 2)

    def missing(self) -> str:
        """Where in the picture the board has not been yet; "" if everywhere."""
        if self._size_px is None:
            return ""
        names = ("top left", "top right", "bottom left", "bottom right")
        seen = np.concatenate([np.zeros((0, 2)), *self.views]) / np.array(self._size_px)
        quarter = (seen[:, 0] > 0.5) + 2 * (seen[:, 1] > 0.5)
        outer = np.abs(seen - 0.5).max(axis=1) > 0.3
        return ", ".join(name for i, name in enumerate(names) if not np.any((quarter == i) & outer))

    def solve(self) -> Lens:
        """The lens that explains the views best.

        Raises:
            ValueError: too few views.
        """
        if len(self.views) < _FEWEST:
            raise ValueError(
                f"{len(self.views)} views of the board are too few: at least {_FEWEST}, better {VIEWS}"
            )
        rms, K, distortion, _, _, sigma, _, _ = self._fit(self.views)
        # Corners of one view are wrong together, which a fit's own errors know nothing of: the focal lengths
        # without each third of the views tell (delete-a-group jackknife).
        without = [
            [uv for i, uv in enumerate(self.views) if i % _GROUPS != group] for group in range(_GROUPS)
        ]
        focals = np.array([self._fit(views)[1][[0, 1], [0, 1]] for views in without])
        spread_px = np.sqrt((_GROUPS - 1) / _GROUPS * np.sum((focals - focals.mean(axis=0)) ** 2, axis=0))
        focal_sigma_px = float(max(np.max(sigma.ravel()[:2]), np.max(spread_px)))
        return Lens(self._size_px, K, distortion.ravel()[:5], focal_sigma_px, float(rms), len(self.views))

    def _fit(self, views: list[np.ndarray]) -> tuple[Any, ...]:
        corners = [uv.reshape(-1, 1, 2) for uv in views]
        return cv2.calibrateCameraExtended([self._grid] * len(views), corners, self._size_px, None, None)
