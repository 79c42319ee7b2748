"""Visibility test: spheres against the view frustum of a keyframe, which ends at its largest depths."""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import NEAR_M

_PAD_PX = 4.0  # margin: the rasterizer's low-pass filter enlarges small Gaussians


def frustum_intersects(
    camera: RasterCamera,
    T_map_camera: np.ndarray,
    reach_m: float | np.ndarray,  # far plane, optical z: one, or float [R, C] by image tile
    centres_map_m: np.ndarray,  # float64 [B, 3]
    radii_m: np.ndarray,  # float64 [B]
) -> np.ndarray:
    """Return bool [B]: spheres that may intersect the view frustum; False is always right."""
    x, y, z = transform_points(inverse(T_map_camera), centres_map_m.reshape(-1, 3)).T
    seen = (z + radii_m > NEAR_M) & (z - radii_m < np.max(reach_m))
    sides = (
        (x, camera.cx_px, camera.fx_px), (-x, camera.width_px - 1 - camera.cx_px, camera.fx_px),
        (y, camera.cy_px, camera.fy_px), (-y, camera.height_px - 1 - camera.cy_px, camera.fy_px),
    )  # fmt: skip
    for across, edge_px, focal_px in sides:
        slope = (edge_px + 0.5 + _PAD_PX) / focal_px
        seen &= across + z * slope > -radii_m * np.hypot(1.0, slope)
    if np.size(reach_m) > 1:
        near, tiles = (z - radii_m)[seen], np.asarray(reach_m)
        rows = _tiles(
            y[seen], z[seen], radii_m[seen], camera.fy_px, camera.cy_px, camera.height_px, tiles.shape[0]
        )
        columns = _tiles(
            x[seen], z[seen], radii_m[seen], camera.fx_px, camera.cx_px, camera.width_px, tiles.shape[1]
        )
        covered = rows[:, :, None] & columns[:, None, :]
        seen[seen] = near < np.where(covered, tiles, 0.0).max(axis=(1, 2))
    return seen


def _tiles(
    across: np.ndarray, z: np.ndarray, radii_m: np.ndarray, focal_px: float, centre_px: float, size_px: int,
    count: int,
) -> np.ndarray:  # fmt: skip
    """Return bool [B, count]: tiles along one image axis that the bounding boxes of spheres may cover."""
    low, high = across - radii_m, across + radii_m
    near, far = np.maximum(z - radii_m, NEAR_M), np.maximum(z + radii_m, NEAR_M)
    first_px = focal_px * low / np.where(low < 0.0, near, far) + centre_px - _PAD_PX
    last_px = focal_px * high / np.where(high > 0.0, near, far) + centre_px + _PAD_PX
    edges_px = np.linspace(0, size_px, count + 1).astype(int) - 0.5  # pixel centres have whole coordinates
    first, last = np.clip(first_px, -0.5, size_px - 0.6), np.clip(last_px, -0.4, size_px - 0.5)
    return (first[:, None] < edges_px[1:]) & (last[:, None] >= edges_px[:-1])
