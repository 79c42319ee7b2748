"""Render a Gaussian map from above, without its ceiling, at a known scale, like a floor plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import MEAN, OPACITY
from beamsplat.common.raster.optimiser import GaussianArrays
from beamsplat.common.raster.rasterizer import Rasterizer

_HEIGHT_M = 60.0  # height of the camera: far enough that walls appear almost vertical
_EDGE_M = 0.4  # margin around the map
_MAX_SIDE_PX = 2000
_MIN_OPACITY_LOGIT = -2.0  # fainter Gaussians do not extend the image
_WHITE = np.ones(3, np.float32)


@dataclass(frozen=True)
class LabelledBox:
    """A rectangle with a label on the view from above; corners (x, y) in metres, colour BGR."""

    low_m: tuple[float, float]
    high_m: tuple[float, float]
    label: str
    bgr: tuple[int, int, int]


def top_view(
    params: np.ndarray,  # float32 [14, N] in a frame whose z points up
    path_m: np.ndarray | None = None,  # [K, >= 2] drawn on it
    *,
    ceiling_m: float = 1.8,  # Gaussians above this height are left out
    metres_per_px: float = 0.015,
    corners_m: np.ndarray | None = None,  # [2, 2], lower and upper corner (x, y); default: around the map
    boxes: Sequence[LabelledBox] = (),  # drawn on it
) -> np.ndarray | None:
    """Return the map from above, BGR uint8 [H, W, 3], x to the right, y up; None if nothing is visible."""
    solid = (
        (params[MEAN + 2] < ceiling_m) & (params[MEAN + 2] > -0.5) & (params[OPACITY] > _MIN_OPACITY_LOGIT)
    )
    if not solid.any():
        return None
    store = GaussianArrays(int(solid.sum()))
    store.append(params[:, solid])
    low, high = extent(params[MEAN : MEAN + 2, solid]) if corners_m is None else corners_m
    scale = max(metres_per_px, float((high - low).max()) / _MAX_SIDE_PX)
    width, height = (int(np.ceil(v / scale)) for v in high - low)
    centre = (low + high) / 2
    T_camera_map = np.eye(4)
    T_camera_map[:3, :3] = np.diag([1.0, -1.0, -1.0])  # looks down; y of the map is up in the image
    T_camera_map[:3, 3] = [-centre[0], centre[1], _HEIGHT_M]
    focal_px = _HEIGHT_M / scale
    camera = RasterCamera(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, width, height)
    rasterizer = Rasterizer()
    render = rasterizer.render(store.params, store.count, camera, T_camera_map, _WHITE)
    rgb = np.clip(render.image[:3] * 255.0 + 0.5, 0, 255).astype(np.uint8).transpose(1, 2, 0)
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    rasterizer.release(render)
    rasterizer.close()

    def pixels(xy_m: np.ndarray) -> np.ndarray:
        x = (xy_m[:, 0] - centre[0]) / scale + (width - 1) / 2
        y = (centre[1] - xy_m[:, 1]) / scale + (height - 1) / 2
        return np.round(np.stack([x, y], axis=1)).astype(np.int32)

    if path_m is not None and len(path_m):
        cv2.polylines(bgr, [pixels(path_m)], False, (40, 40, 220), 2, cv2.LINE_AA)
    for box in boxes:
        first, last = pixels(np.array([box.low_m, box.high_m], dtype=np.float64)).tolist()
        cv2.rectangle(bgr, first, last, box.bgr, 2)
        at = (min(first[0], last[0]) + 3, max(first[1], last[1]) - 4)
        cv2.putText(bgr, box.label, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, box.bgr, 2, cv2.LINE_AA)
    _scale_bar(bgr, scale)
    return bgr


def extent(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner float64 [2] in m of a rectangle around points xy [2, N].

    It contains 99 % of the points per axis, plus a margin: a few outliers must not shrink the rest.
    """
    return np.percentile(xy, 0.5, axis=1) - _EDGE_M, np.percentile(xy, 99.5, axis=1) + _EDGE_M


def _scale_bar(bgr: np.ndarray, metres_per_px: float) -> None:
    px = round(1.0 / metres_per_px)
    y = bgr.shape[0] - 12
    cv2.line(bgr, (12, y), (12 + px, y), (0, 0, 0), 2)
    cv2.putText(bgr, "1 m", (16 + px, y + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
