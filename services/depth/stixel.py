"""Source `stixel`: each image column is a vertical surface at the range of its beam, on the floor plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.beams import azimuth_and_range, occluded_beams, plane_depth, wall_ranges
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.services.depth.source import DepthInput, Estimate

_FINE = 2  # azimuths per pixel column


@dataclass(frozen=True)
class _PixelRays:
    """Pixel rays of one camera in the body frame, computed once."""

    camera: Pinhole
    T_body_camera: np.ndarray
    azimuth_rad: np.ndarray  # float64 [M]: azimuths over the field of view
    azimuth_index: np.ndarray  # int32 [H, W]: index of each pixel's azimuth
    per_range: np.ndarray  # float32 [H, W]: optical z per metre of horizontal range
    floor: np.ndarray  # float32 [H, W]: optical z of the floor, inf = not hit


class Stixel:
    """Depth source of vertically extruded beams, cut off by the floor plane if the camera height is known."""

    def __init__(self, max_depth_m: float = 30.0) -> None:
        self._max_depth_m = max_depth_m
        self._rays: _PixelRays | None = None

    def estimate(self, view: DepthInput) -> Estimate:
        """Return metric depth, NaN in columns without a beam (except on the floor)."""
        rays = self._rays
        if (
            rays is None
            or rays.camera != view.camera
            or not np.array_equal(rays.T_body_camera, view.T_body_camera)
        ):
            rays = self._rays = _prepare(view.camera, view.T_body_camera)
        points = view.beams.points_body_m
        points = points[~occluded_beams(points, view.T_body_camera)]
        azimuth, reach = azimuth_and_range(points, view.T_body_camera)
        ranges = wall_ranges(rays.azimuth_rad, azimuth, reach).astype(np.float32)
        values = ranges[rays.azimuth_index] * rays.per_range
        if view.floor_known:
            values = np.fmin(values, rays.floor)
        with np.errstate(invalid="ignore"):
            values[values > self._max_depth_m] = np.nan
        status = "ok" if np.isfinite(values).any() else "no beams in view, and the camera height is unknown"
        return Estimate(values, "metric", status)


def _prepare(camera: Pinhole, T_body_camera: np.ndarray) -> _PixelRays:
    rays_body = camera.ray_grid() @ T_body_camera[:3, :3].T
    azimuth = np.arctan2(rays_body[..., 1], rays_body[..., 0])
    azimuths = np.linspace(float(azimuth.min()), float(azimuth.max()), _FINE * camera.width_px)
    azimuth_index = np.rint(
        (azimuth - azimuths[0]) / max(azimuths[-1] - azimuths[0], 1e-9) * (len(azimuths) - 1)
    )
    ray_xy = np.maximum(np.hypot(rays_body[..., 0], rays_body[..., 1]), 1e-9)
    floor = plane_depth(rays_body, float(T_body_camera[2, 3]))
    return _PixelRays(
        camera, T_body_camera.copy(), azimuths, azimuth_index.astype(np.int32),
        (1.0 / ray_xy).astype(np.float32),
        np.where(np.isfinite(floor), floor, np.inf).astype(np.float32),
    )  # fmt: skip
