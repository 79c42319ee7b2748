"""Image mask of dynamic objects: the lidar measures a person's ankles, the image shows the whole body."""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.beams import azimuth_and_range
from beamsplat.common.geometry.camera import Pinhole

HEIGHT_M = 2.1  # of a person
_HALF_WIDTH_M = 0.30  # of a person with arms, around the beams on the ankles
_CLUSTER_COUNT, _CLUSTER_M = 3, 0.5  # least returns within that distance: a single one is an edge or noise
_CORE_M = 0.09  # around the ankles: masked at any depth
_FLOOR_M = 0.15  # below the floor plane, for shadows and for pitch of the camera
_DEPTH_M = 0.45  # a stride forward and backward
_DILATION_PX = 4  # position error of depth edges


def dynamic_object_mask(
    dynamic_body_m: np.ndarray,  # float64 [N, 3]: dynamic returns, in the body frame at the image time
    depth_m: np.ndarray,  # float32 [H, W] optical z, NaN = unknown
    camera: Pinhole,
    T_body_camera: np.ndarray,
    step: int = 4,
) -> np.ndarray:
    """Return bool [H, W]: True where the image shows a dynamic object, up to 2.1 m above the floor.

    A pixel is masked if a point on its ray, at the range of a dynamic return, is within 0.3 m to the side of
    this return, and the pixel's depth is unknown or within a stride of this range; or if this point is within
    9 cm and no surface is known in front of it. The mask is computed at every `step`-th pixel.
    """
    mask: np.ndarray = np.zeros(depth_m.shape, dtype=bool)
    if len(dynamic_body_m) == 0:
        return mask
    rays = camera.ray_grid()[::step, ::step] @ T_body_camera[:3, :3].T
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    ray_xy = np.hypot(rays[..., 0], rays[..., 1])
    coarse = np.zeros(azimuth.shape, dtype=bool)
    small = depth_m[::step, ::step]
    for at, reach in zip(*azimuth_and_range(_clustered(dynamic_body_m), T_body_camera)):
        half, core = np.arctan2([_HALF_WIDTH_M, _CORE_M], max(float(reach), 0.2))
        apart = np.abs((azimuth - at + np.pi) % (2.0 * np.pi) - np.pi)
        z = reach / np.maximum(ray_xy, 1e-9)
        height = T_body_camera[2, 3] + rays[..., 2] * z
        upright = (height > -_FLOOR_M) & (height < HEIGHT_M)
        with np.errstate(invalid="ignore"):
            behind = small * ray_xy > reach + _DEPTH_M
            before = small * ray_xy < reach - _DEPTH_M
        # Depth from static surfaces may be behind a person that it has not detected. Near the azimuth of the
        # beams the person is assumed, farther away the depth is trusted.
        coarse |= upright & (apart < half) & ~before & ((apart < core) | ~behind)
    grown = np.kron(coarse, np.ones((step, step), dtype=bool))[: mask.shape[0], : mask.shape[1]]
    mask[: grown.shape[0], : grown.shape[1]] = grown
    return _dilated(mask)


def _clustered(points_m: np.ndarray) -> np.ndarray:
    """Return the points [M, 3] with enough neighbours in the floor plane, as returns of two ankles have."""
    apart = np.linalg.norm(points_m[:, None, :2] - points_m[None, :, :2], axis=2)
    return points_m[np.count_nonzero(apart < _CLUSTER_M, axis=1) >= _CLUSTER_COUNT]


def _dilated(mask: np.ndarray) -> np.ndarray:
    out = mask.copy()
    for axis in (0, 1):
        reach = out.copy()
        for shift in range(1, _DILATION_PX + 1):
            for sign in (-shift, shift):
                moved = np.roll(out, sign, axis=axis)
                edge = np.s_[:sign] if sign > 0 else np.s_[sign:]
                moved[(edge,) if axis == 0 else (slice(None), edge)] = False
                reach |= moved
        out = reach
    return out
