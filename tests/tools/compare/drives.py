"""Two drives through the simulated flat, between which a box has moved; and views of a box room."""

import numpy as np

from beamsplat.common.geometry.transforms import inverse, se2_to_se3
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.tools.compare.drive import DepthView, MappedDrive
from tests.services.localization.world import WALLS, RayCastLidar, SimulatedDrive, box

OLD, NEW, SIZE_M = (7.8, 5.2), (1.6, 0.4), 0.4  # of the box that moves, in the world
STEP_NS = 100_000_000


def mapped_flat(place, start_s=0.0, seconds=52.0, seed=0) -> tuple[LidarSlam, np.ndarray]:
    """Return the lidar map of a drive with the box at `place` (None: without it), and its pose in the world."""
    walls = WALLS if place is None else np.concatenate([WALLS, box(*place, SIZE_M)])
    slam, lidar, path = (
        LidarSlam(LidarSlamSettings(), np.eye(4)),
        RayCastLidar(beams=240, seed=seed),
        SimulatedDrive(),
    )
    for number in range(int(seconds * 10)):
        result = slam.add_scan(
            10**18 + seed * 10**15 + number * STEP_NS,
            lidar.scan(path, start_s + number * 0.1, walls),
            *lidar.arguments(),
        )
        if result.job is not None:
            slam.apply(result.job.run())
    slam.finish()
    return slam, path(np.array([start_s]))[0]


def drive_of(slam: LidarSlam, poses: dict[int, np.ndarray]) -> MappedDrive:
    """Return a session with a lidar map only."""
    return MappedDrive("flat", None, slam, poses, [], lambda id: None)


CAMERA = RasterCamera(130.0, 130.0, 79.5, 59.5, 160, 120)
# Camera axes (x right, y down, z ahead) in a body that looks along x, at a height of 0.5 m.
T_BODY_CAMERA = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1.0]])


def view_of_room(number, x_m, y_m, yaw_rad, blocks, sigma_m=0.03, far_m=4.0) -> DepthView:
    """Return a view with exact depth of a wall at x = `far_m`, a floor at z = 0, and boxes [K, 6] (low, high)."""
    T = se2_to_se3(np.array([x_m, y_m, yaw_rad])) @ T_BODY_CAMERA
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    rays = np.stack(
        [(u - CAMERA.cx_px) / CAMERA.fx_px, (v - CAMERA.cy_px) / CAMERA.fy_px, np.ones(u.shape)], axis=-1
    )
    d, o = rays @ T[:3, :3].T, T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.fmin(
            *(np.where(t > 0, t, np.inf) for t in ((far_m - o[0]) / d[..., 0], -o[2] / d[..., 2]))
        )
        for block in blocks:
            t0, t1 = ((np.array(corner) - o) / d for corner in (block[:3], block[3:]))
            enter, leave = np.minimum(t0, t1).max(axis=-1), np.maximum(t0, t1).min(axis=-1)
            depth = np.where((enter < leave) & (enter > 0), np.minimum(depth, enter), depth)
    depth = np.where(np.isfinite(depth), depth, np.nan).astype(np.float16)
    sigma = np.full(depth.shape, sigma_m, np.float16)
    return DepthView(number, CAMERA, T, depth, sigma, depth, np.full((*depth.shape, 3), 128, np.uint8))


def views_of_room(blocks, **options) -> list[DepthView]:
    """Return nine views from three places 0.4 m apart."""
    poses = [(0.0, y, yaw) for y in (-0.4, 0.0, 0.4) for yaw in (-0.15, 0.0, 0.15)]
    return [view_of_room(k, *pose, blocks, **options) for k, pose in enumerate(poses)]


def pose_in(pose_world_a: np.ndarray, pose_world_b: np.ndarray) -> np.ndarray:
    """Return the true pose of b in a."""
    T = inverse(se2_to_se3(pose_world_a)) @ se2_to_se3(pose_world_b)
    return np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])
