"""Validation of a board calibration by the vertical edges of the board in image and scan.

The calibration uses only the planes of the boards, so the edges are independent data. A beam whose spot falls
only partly on the board still returns a range: in a scan, a board appears wider by the same angle at both
edges. The median over all edges removes this offset. The remaining error is at best half the beam spacing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.transforms import transform_points
from beamsplat.services.fusion.calibration.board import BoardPair

_WINDOW_PX = 25  # search range on each side of the outermost beam
_ACROSS_PX = 3  # image rows averaged on each side of the scan line
_LEAST_STEP = 12.0  # grey values between board and background


@dataclass(frozen=True)
class EdgeErrors:
    """Horizontal differences (px) between the outermost beams on a board and its edges in the image."""

    errors_px: np.ndarray  # float64 [edges]: beams beyond the edge, minus `spot_px`
    spot_px: float  # apparent widening of boards at each edge

    @property
    def median_px(self) -> float:
        return float(np.median(np.abs(self.errors_px))) if len(self.errors_px) else float("nan")


def image_edges(grey: np.ndarray, camera: Pinhole, uv_px: np.ndarray) -> np.ndarray:
    """Return the image columns (px) of the left and right board edge, float64 [2]; NaN = edge not found.

    Args:
        grey: uint8 [H, W], with lens distortion.
        camera: camera model of the image.
        uv_px: float64 [N, 2], the beams on the board, projected to the undistorted image, in any order.

    The columns belong to the undistorted image. The board must be brighter than its background.
    """
    flat = Undistorter(camera)(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB))[..., 0].astype(np.float32)
    uv = uv_px[np.argsort(uv_px[:, 0])]
    slope, row = np.polyfit(uv[:, 0], uv[:, 1], 1)
    out = np.full(2, np.nan)
    for side, end in enumerate((uv[0, 0], uv[-1, 0])):
        u = np.arange(round(end) - _WINDOW_PX, round(end) + _WINDOW_PX + 1).astype(np.float32)
        profile = np.zeros(len(u))
        for across in range(-_ACROSS_PX, _ACROSS_PX + 1):
            v = (slope * u + row + across).astype(np.float32)
            profile += cv2.remap(flat, u[None], v[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
        profile = cv2.GaussianBlur(profile[None] / (2 * _ACROSS_PX + 1), (0, 0), 1.0)[0]
        inside = (u >= 1) & (u <= camera.width_px - 2)
        fall = np.gradient(profile) * (1.0 if side == 0 else -1.0)  # the board is the brighter side
        fall[~inside] = 0.0
        k = int(np.argmax(fall[1:-1])) + 1
        step = abs(float(profile[min(k + 4, len(u) - 1)] - profile[max(k - 4, 0)]))
        bend = fall[k - 1] + fall[k + 1] - 2.0 * fall[k]
        if step > _LEAST_STEP and bend < 0.0:
            out[side] = u[k] + 0.5 * (fall[k - 1] - fall[k + 1]) / bend
    return out


def edge_errors(
    pairs: list[BoardPair], on_board: tuple[np.ndarray, ...], edges_px: list[np.ndarray],
    T_camera_lidar: np.ndarray, pinhole: Pinhole,
) -> EdgeErrors:  # fmt: skip
    """Return the differences (px) between the outermost beams on each board and its edges in the image.

    Args:
        pairs: boards with their scans.
        on_board: indices of the beams on each board (`BoardCalibration.on_board`).
        edges_px: for each pair, the result of `image_edges` (float64 [2], NaN = not found).
        T_camera_lidar: the calibration to validate.
        pinhole: the camera without distortion.
    """
    outwards = []
    for pair, beams, edge in zip(pairs, on_board, edges_px):
        if len(beams):
            u = pinhole.project(transform_points(T_camera_lidar, pair.points_lidar[beams]))[0][:, 0]
            outwards += [edge[0] - u.min(), u.max() - edge[1]]
    errors = np.array(outwards)
    errors = errors[np.isfinite(errors)]
    spot = float(np.median(errors)) if len(errors) else float("nan")
    return EdgeErrors(errors - spot, spot)
