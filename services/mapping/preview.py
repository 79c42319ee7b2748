"""Renders of the map from the viewpoint of a keyframe, with the error against it, and from any other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.mapfiles.scores import rgb_depth_alpha
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.mapping.mapper import HALF, Mapper

_MOST_FROM_DISK = 500_000  # Gaussians read for one render: 28 MB


@dataclass(frozen=True)
class KeyframeRender:
    """The map rendered at half size at the pose of a keyframe, with the errors against the keyframe."""

    rgb: np.ndarray  # uint8 [h, w, 3]
    camera: RasterCamera  # of the render
    T_map_camera: np.ndarray
    psnr_db: float  # against the keyframe's image, without dynamic objects
    depth_error_m: float  # median |rendered - measured| where depth was measured; NaN without any


def render_keyframe(mapper: Mapper, id: int) -> KeyframeRender:
    """Render the map with the refined pose and exposure of a keyframe, and compare it with the keyframe.

    Raises:
        KeyError: the keyframe is not in memory.
    """
    keyframe = mapper.keyframes[id]
    level = keyframe.levels[HALF]
    T_map_camera = mapper.T_map_camera(keyframe)
    rgb, depth, alpha = rgb_depth_alpha(mapper.render(level.camera, T_map_camera))
    shown = np.clip(rgb * np.exp(keyframe.exposure[:3]) + keyframe.exposure[3:], 0.0, 1.0)
    truth = level.rgb.transpose(1, 2, 0).astype(np.float32) / 255.0
    static = np.ones(truth.shape[:2], bool) if level.hidden is None else ~level.hidden
    error = float(np.mean((shown - truth)[static] ** 2)) if static.any() else float("nan")
    known = (level.depth_mm > 0) & (alpha > 0.5) & np.isfinite(depth)
    depth_error = np.abs(depth[known] - level.depth_mm[known] * np.float32(1e-3))
    return KeyframeRender(
        (shown * 255.0 + 0.5).astype(np.uint8), level.camera, T_map_camera,
        float(-10.0 * np.log10(max(error, 1e-12))),
        float(np.median(depth_error)) if len(depth_error) else float("nan"),
    )  # fmt: skip


class MapView(NamedTuple):
    """The map rendered from any pose."""

    rgb: np.ndarray  # uint8 [H, W, 3]
    camera: RasterCamera
    left_out: int  # Gaussians that may be in view, but are on disk and were not read


def render_view(mapper: Mapper, T_map_camera: np.ndarray, camera: RasterCamera | None) -> MapView:
    """Render the map from a pose, with what is on disk; the map itself stays as it is.

    Args:
        camera: None = the camera of the newest keyframe in memory, at half size.
    """
    if camera is None:
        camera = next(k.levels[HALF].camera for k in reversed(mapper.keyframes.values()))
    parts: list[np.ndarray] = []
    left_out = 0
    if mapper.disk_gaussians is not None:
        parts, left_out = mapper.disk_gaussians.read_visible(
            camera, T_map_camera, mapper.T_map_anchor, _MOST_FROM_DISK
        )
    image = mapper.engine.render_with(camera, inverse(T_map_camera), parts)
    rgb = (np.clip(image[:3].transpose(1, 2, 0), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    return MapView(rgb, camera, left_out)
