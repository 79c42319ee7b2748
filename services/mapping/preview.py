"""How the map looks from a keyframe that it holds, and how well it fits there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.mapfiles.scores import render_rgb_depth
from beamsplat.services.mapping.mapper import HALF, Mapper


@dataclass(frozen=True)
class Look:
    """A render at half size beside its keyframe."""

    rgb: np.ndarray  # uint8 [h, w, 3]
    T_map_camera: np.ndarray
    psnr_db: float  # against the picture, movers left out
    depth_error_m: float  # median |rendered - measured| where depth was measured; NaN without any


def look(mapper: Mapper, keyframe: int) -> Look:
    """The view of a keyframe, with its refined pose and exposure.

    Raises:
        KeyError: the mapper does not hold it.
    """
    held = mapper.keyframes[keyframe]
    level = held.levels[HALF]
    T_map_camera = mapper.T_map_camera(held)
    rgb, depth, alpha = render_rgb_depth(mapper.rasterizer, mapper.store, level.camera, T_map_camera)
    shown = np.clip(rgb * np.exp(held.exposure[:3]) + held.exposure[3:], 0.0, 1.0)
    truth = level.rgb.transpose(1, 2, 0).astype(np.float32) / 255.0
    looked_at = np.ones(truth.shape[:2], bool) if level.hidden is None else ~level.hidden
    error = float(np.mean((shown - truth)[looked_at] ** 2)) if looked_at.any() else float("nan")
    known = (level.depth_mm > 0) & (alpha > 0.5) & np.isfinite(depth)
    off = np.abs(depth[known] - level.depth_mm[known] * np.float32(1e-3))
    return Look(
        (shown * 255.0 + 0.5).astype(np.uint8), T_map_camera, float(-10.0 * np.log10(max(error, 1e-12))),
        float(np.median(off)) if len(off) else float("nan"),
    )  # fmt: skip
