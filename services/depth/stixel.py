"""`stixel`: no weights at all. Each image column is a vertical surface at the beam's range on the floor."""

from __future__ import annotations

import numpy as np

from common.beams import hidden_beams, plan_polar, plane_depth, wall_depth
from services.depth.source import Estimate, View


class Stixel:
    """Beams extruded upright, and the floor plane where the camera height is known."""

    def __init__(self, max_depth_m: float = 30.0) -> None:
        self._max_depth_m = max_depth_m

    def estimate(self, view: View) -> Estimate:
        """Metric depth; NaN in columns that no beam serves (floor excepted)."""
        values = stixel_depth(view, view.camera.ray_grid())
        with np.errstate(invalid="ignore"):
            values[values > self._max_depth_m] = np.nan
        status = "ok" if np.isfinite(values).any() else "no beams in view and no floor known"
        return Estimate(values.astype(np.float32), "metric", status)


def stixel_depth(view: View, rays_camera: np.ndarray) -> np.ndarray:
    """Optical z float64 [H, W] for rays [H, W, 3] of z = 1."""
    rays_body = rays_camera @ view.T_body_camera[:3, :3].T
    points = view.beams.points_body_m
    points = points[~hidden_beams(points, view.T_body_camera)]
    azimuth, reach = plan_polar(points, view.T_body_camera)
    wall = wall_depth(rays_body, azimuth, reach)
    if not view.floor_known:
        return wall
    return np.fmin(wall, plane_depth(rays_body, float(view.T_body_camera[2, 3])))
