"""Depth of keyframes for evaluating the mapper: the true depth, or depth from beams and floor plane alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import azimuth_and_range, occluded_beams, plane_depth, wall_depth
from beamsplat.tools.evaluation.dataset import TruthDataset

# (recording, index of the image) -> depth_m, sigma_m float32 [H, W]; None without depth.
Prior = Callable[[TruthDataset, int], tuple[np.ndarray, np.ndarray] | None]


def true_depth(recording: TruthDataset, index: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the true depth of an image with a sigma of 1 cm; None if the image has none."""
    depth = recording.true_depth(index)
    return None if depth is None else (depth, np.full(depth.shape, 0.01, np.float32))


def stixel(recording: TruthDataset, index: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return depth of vertical walls at the beams, cut off by the floor plane.

    The floor is certain where it is nearer than the wall. A wall is certain at the height of the beams; its
    sigma grows with the vertical distance from there.
    """
    beams, T_body_camera = recording.posed_images[index].beams, recording.T_body_camera
    if len(beams) == 0:
        return None
    rays = recording.camera.ray_grid() @ T_body_camera[:3, :3].T
    points = beams.points_body_m[~occluded_beams(beams.points_body_m, T_body_camera)]
    azimuth, reach = azimuth_and_range(points, T_body_camera)
    wall = wall_depth(rays, azimuth, reach)
    floor = plane_depth(rays, float(T_body_camera[2, 3]))
    depth = np.fmin(wall, floor)
    height = T_body_camera[2, 3] + depth * rays[..., 2]
    lidar_height = float(np.median(points[:, 2]))
    height_difference = np.abs(height - lidar_height)
    sigma = np.where(floor < wall, 0.03, 0.02 + 0.15 * height_difference)
    return depth.astype(np.float32), sigma.astype(np.float32)


PRIORS: dict[str, Prior] = {"truth": true_depth, "stixel": stixel}


def find_prior(name: str) -> Prior:
    """Return the prior called `name`.

    Raises:
        UserError: there is no such prior.
    """
    if name not in PRIORS:
        raise UserError(f"unknown depth prior {name!r}; known are {', '.join(PRIORS)}")
    return PRIORS[name]
