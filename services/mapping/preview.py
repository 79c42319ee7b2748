"""Preview of the map from a keyframe's viewpoint, with its error against the keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.mapfiles.scores import render_rgb_depth
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.mapping.mapper import HALF, Mapper


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
    rgb, depth, alpha = render_rgb_depth(mapper.rasterizer, mapper.store, level.camera, T_map_camera)
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
