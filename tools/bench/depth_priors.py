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
    """Return (depth_m, sigma_m) float32 [H, W]: the true optical z of an image, and a sigma of 1 cm.

    None if the recording has no true depth of this image.
    """
    depth = recording.true_depth(index)
    return None if depth is None else (depth, np.full(depth.shape, 0.01, np.float32))


def stixel(recording: TruthDataset, index: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return (depth_m, sigma_m) float32 [H, W] of vertical walls at the lidar beams and of the floor plane.

    Each pixel has the optical z of the nearer surface. The sigma of the floor is 3 cm. The sigma of a wall is
    2 cm at the height of the beams and grows by 15 cm per metre of vertical distance from the beams. None if
    there are no beams at the time of the image.
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
    """Return the depth prior called `name`, a key of `PRIORS`.

    Raises:
        UserError: no depth prior has this name.
    """
    if name not in PRIORS:
        raise UserError(f"unknown depth prior {name!r}; known are {', '.join(PRIORS)}")
    return PRIORS[name]
