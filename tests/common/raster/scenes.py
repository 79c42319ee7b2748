"""Random scenes for tests of the rasterizers."""

import numpy as np

from beamsplat.common.geometry.transforms import make_transform, so3_exp
from beamsplat.common.raster.camera import RasterCamera

GROUPS = ("mean_map_m", "log_scale", "quat_wxyz", "opacity_logit", "colour")


def random_pose(rng):
    return make_transform(so3_exp(rng.normal(size=3)), rng.normal(size=3))


def random_camera(rng, width_px=61, height_px=47):
    f = rng.uniform(0.7, 1.2) * width_px
    return RasterCamera(f, f * rng.uniform(0.95, 1.05), width_px * rng.uniform(0.4, 0.6), height_px * rng.uniform(0.4, 0.6),
                        width_px, height_px)  # fmt: skip


def random_gaussians(rng, T_camera_map, count=400, spread=1.4):
    """Return five float64 arrays of Gaussians: some at the border, outside, behind the camera, or very large."""
    z = rng.uniform(-1.0, 6.0, count)
    slope = rng.uniform(-spread, spread, (count, 2)) * 0.6
    points = np.column_stack([slope * np.abs(z)[:, None], z])
    R, t = T_camera_map[:3, :3], T_camera_map[:3, 3]
    mean = (points - t) @ R
    log_scale = np.log(rng.uniform(0.01, 0.15, (count, 3)))
    log_scale[: count // 50] += 1.5
    quat = rng.normal(size=(count, 4))
    return mean, log_scale, quat, rng.normal(size=count) * 2.0, rng.uniform(0.0, 1.0, (count, 3))
