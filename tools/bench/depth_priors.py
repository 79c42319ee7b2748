"""Depth for keyframes when measuring the mapper: the truth, or what beams and floor alone say."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import azimuth_and_range, occluded_beams, plane_depth, wall_depth
from beamsplat.tools.evaluation.dataset import Recording

# (recording, number of the picture) -> depth_m, sigma_m float32 [H, W]; None where it has none.
Prior = Callable[[Recording, int], tuple[np.ndarray, np.ndarray] | None]


def true_depth(recording: Recording, index: int) -> tuple[np.ndarray, np.ndarray] | None:
    """The recording's own depth, for pictures that have one."""
    depth = recording.true_depth(index)
    return None if depth is None else (depth, np.full(depth.shape, 0.01, np.float32))


def stixel(recording: Recording, index: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Beams extruded upright, cut by the floor plane; sigma grows away from the row that the lidar sees.

    The floor is certain where it is nearer than the beam; a wall is certain at the beam's own height.
    """
    beams, T_body_camera = recording.shots[index].beams, recording.T_body_camera
    if len(beams) == 0:
        return None
    rays = recording.camera.ray_grid() @ T_body_camera[:3, :3].T
    points = beams.points_body_m[~occluded_beams(beams.points_body_m, T_body_camera)]
    azimuth, reach = azimuth_and_range(points, T_body_camera)
    wall = wall_depth(rays, azimuth, reach)
    floor = plane_depth(rays, float(T_body_camera[2, 3]))
    depth = np.fmin(wall, floor)
    # How far above (or below) the beams' height the pixel's point lies decides how much a wall is a guess.
    height = T_body_camera[2, 3] + depth * rays[..., 2]
    lidar_height = float(np.median(points[:, 2]))
    guessed = np.abs(height - lidar_height)
    sigma = np.where(floor < wall, 0.03, 0.02 + 0.15 * guessed)
    return depth.astype(np.float32), sigma.astype(np.float32)


PRIORS: dict[str, Prior] = {"truth": true_depth, "stixel": stixel}


def find_prior(name: str) -> Prior:
    """The prior called `name`.

    Raises:
        UserError: there is none.
    """
    if name not in PRIORS:
        raise UserError(f"there is no depth prior {name!r}; there are {', '.join(PRIORS)}")
    return PRIORS[name]
