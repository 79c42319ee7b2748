"""Calibrate a camera's intrinsics and distortion, with standard errors, from images of a chessboard."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from beamsplat.tools.setup.chessboard import Chessboard

VIEWS = 12  # wanted
_FIND_WIDTH_PX = 960  # corners are searched at this width, and refined in the full image
_MIN_CORNER_SHIFT = 0.05  # mean distance from the corners of earlier views, as a ratio of the image width
_GOOD_RMS_PX = 1.0  # largest acceptable reprojection error
_JACKKNIFE_GROUPS = 3
_MIN_VIEWS = 6  # for a solution


@dataclass(frozen=True)
class CameraIntrinsics:
    """Camera matrix K in px, plumb-bob distortion (k1, k2, p1, p2, k3), and their accuracy."""

    size_px: tuple[int, int]  # width, height
    K: np.ndarray  # float64 [3, 3]
    distortion: np.ndarray  # float64 [5]
    focal_sigma_px: float  # standard error of the focal length, the larger of fx and fy
    rms_px: float  # reprojection error over all corners
    views: int

    @property
    def is_good(self) -> bool:
        """Whether reprojection error (< 1 px) and standard error of the focal length (< 2 %) are small."""
        return self.rms_px < _GOOD_RMS_PX and self.focal_sigma_px < 0.02 * self.K[0, 0]


class IntrinsicsCalibration:
    """Calibration of a camera from views of a chessboard at different places in the image.

    Call `add` for images until there are enough `views`, then `solve`.
    """

    def __init__(self, board: Chessboard) -> None:
        self._board = board
        self._grid = np.zeros((board.corners[0] * board.corners[1], 3), np.float32)
        self._grid[:, :2] = np.mgrid[: board.corners[0], : board.corners[1]].T.reshape(-1, 2) * board.square_m
        self.views: list[np.ndarray] = []  # float32 [N, 2] corners of each
        self._size_px: tuple[int, int] | None = None

    def add(self, grey: np.ndarray) -> str:
        """Search the board in a grey image uint8 [H, W]; add the view if it differs from the earlier views.

        Returns "taken" if the view was added, "no board" if the board was not found, "too alike" if the board
        is near its place in an earlier view. All images must have the same size.
        """
        self._size_px = grey.shape[1], grey.shape[0]
        uv = self._corners(grey)
        if uv is None:
            return "no board"
        # A board turned by 180 degrees looks the same: its corners are found in reverse order.
        far = _MIN_CORNER_SHIFT * grey.shape[1]
        for other in self.views:
            if min(np.abs(uv - other).mean(), np.abs(uv[::-1] - other).mean()) < far:
                return "too alike"
        self.views.append(uv)
        return "taken"

    def _corners(self, grey: np.ndarray) -> np.ndarray | None:
        scale = min(_FIND_WIDTH_PX / grey.shape[1], 1.0)
        small = (
            grey if scale == 1.0 else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        )
        found, uv = cv2.findChessboardCornersSB(small, self._board.corners, flags=cv2.CALIB_CB_ACCURACY)
        if not found:
            return None
        uv = (uv.reshape(-1, 2).astype(np.float32) + 0.5) / scale - 0.5
        if scale < 1.0:
            criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.01)
            uv = cv2.cornerSubPix(grey, np.ascontiguousarray(uv), (5, 5), (-1, -1), criteria)
        return uv.reshape(-1, 2)

    def missing(self) -> str:
        """Return the corners of the image that no view of the board covers yet, as text; "" without any."""
        if self._size_px is None:
            return ""
        names = ("top left", "top right", "bottom left", "bottom right")
        seen = np.concatenate([np.zeros((0, 2)), *self.views]) / np.array(self._size_px)
        quarter = (seen[:, 0] > 0.5) + 2 * (seen[:, 1] > 0.5)
        outer = np.abs(seen - 0.5).max(axis=1) > 0.3
        return ", ".join(name for i, name in enumerate(names) if not np.any((quarter == i) & outer))

    def solve(self) -> CameraIntrinsics:
        """Estimate the intrinsics and their standard error from the views (least squares of OpenCV).

        Raises:
            ValueError: there are too few views.
        """
        if len(self.views) < _MIN_VIEWS:
            raise ValueError(
                f"{len(self.views)} views of the board are too few: at least {_MIN_VIEWS}, better {VIEWS}"
            )
        rms, K, distortion, _, _, sigma, _, _ = self._fit(self.views)
        # Errors of the corners of one view are correlated, which the fit's covariance ignores. The focal
        # lengths without each third of the views show it (delete-a-group jackknife).
        without = [
            [uv for i, uv in enumerate(self.views) if i % _JACKKNIFE_GROUPS != group]
            for group in range(_JACKKNIFE_GROUPS)
        ]
        focals = np.array([self._fit(views)[1][[0, 1], [0, 1]] for views in without])
        spread_px = np.sqrt(
            (_JACKKNIFE_GROUPS - 1) / _JACKKNIFE_GROUPS * np.sum((focals - focals.mean(axis=0)) ** 2, axis=0)
        )
        assert self._size_px is not None  # set by the first view
        focal_sigma_px = float(max(np.max(sigma.ravel()[:2]), np.max(spread_px)))
        return CameraIntrinsics(
            self._size_px, K, distortion.ravel()[:5], focal_sigma_px, float(rms), len(self.views)
        )

    def _fit(self, views: list[np.ndarray]) -> tuple[Any, ...]:
        corners = [uv.reshape(-1, 1, 2) for uv in views]
        # The stubs do not allow None for the matrices that are estimated.
        return cv2.calibrateCameraExtended(  # type: ignore[call-overload]
            [self._grid] * len(views), corners, self._size_px, None, None
        )
