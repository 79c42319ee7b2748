"""A coloured point cloud of one fused picture."""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.services.fusion.result import Fused


def coloured_cloud(
    fused: Fused,
    image_rgb: np.ndarray,  # uint8 [H, W, 3], undistorted
    camera: Pinhole,  # of that size
    T_map_camera: np.ndarray,
    *,
    stride: int = 4,
    max_sigma_share: float = 0.1,
    masked: np.ndarray | None = None,  # bool [H, W]: pixels left out (movers)
) -> tuple[np.ndarray, np.ndarray]:
    """(points float32 [N, 3] in the map, colours uint8 [N, 3]) of every `stride`-th pixel that is sure.

    Sure: sigma is at most `max_sigma_share` of the depth.
    """
    v, u = np.mgrid[stride // 2 : camera.height_px : stride, stride // 2 : camera.width_px : stride]
    v, u = v.ravel(), u.ravel()
    z, sigma = fused.depth_m[v, u], fused.sigma_m[v, u]
    with np.errstate(invalid="ignore"):
        keep = np.isfinite(z) & (sigma <= max_sigma_share * z)
    if masked is not None:
        keep &= ~masked[v, u]
    v, u, z = v[keep], u[keep], z[keep].astype(np.float64)
    points = camera.rays(np.stack([u, v], axis=1).astype(np.float64)) * z[:, None]
    points_map = points @ T_map_camera[:3, :3].T + T_map_camera[:3, 3]
    return points_map.astype(np.float32), np.ascontiguousarray(image_rgb[v, u])
