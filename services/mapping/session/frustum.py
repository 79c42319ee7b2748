"""Visibility test: spheres against the view frustum of a keyframe, which ends at its largest depth."""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import NEAR_M

_PAD_PX = 4.0  # margin: the rasterizer's low-pass filter enlarges small Gaussians


def frustum_intersects(
    camera: RasterCamera,
    T_map_camera: np.ndarray,
    reach_m: float,  # far plane, optical z
    centres_map_m: np.ndarray,  # float64 [B, 3]
    radii_m: np.ndarray,  # float64 [B]
) -> np.ndarray:
    """Return bool [B]: spheres that may intersect the view frustum; False is always right."""
    x, y, z = transform_points(inverse(T_map_camera), centres_map_m.reshape(-1, 3)).T
    seen = (z + radii_m > NEAR_M) & (z - radii_m < reach_m)
    sides = (
        (x, camera.cx_px, camera.fx_px), (-x, camera.width_px - 1 - camera.cx_px, camera.fx_px),
        (y, camera.cy_px, camera.fy_px), (-y, camera.height_px - 1 - camera.cy_px, camera.fy_px),
    )  # fmt: skip
    for across, edge_px, focal_px in sides:
        slope = (edge_px + 0.5 + _PAD_PX) / focal_px
        seen &= across + z * slope > -radii_m * np.hypot(1.0, slope)
    return seen
