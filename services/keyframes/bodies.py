"""Pixels on somebody who walks: the lidar sees the ankles, the picture the whole body."""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.beams import azimuth_and_range
from beamsplat.common.geometry.camera import Pinhole

HEIGHT_M = 2.1
_HALF_WIDTH_M = 0.30  # of a body with its arms, around the beams at its ankles
_COMPANY, _COMPANY_M = 3, 0.5  # returns within that distance of each other: one alone is an edge or noise
_CORE_M = 0.09  # around the ankles: the walker itself, whatever the depth says
_FLOOR_M = 0.15  # shadows, and a camera that nods
_DEPTH_M = 0.45  # a stride to the front and to the back
_SHADOW_PX = 4  # depth edges lie that far off


def body_mask(
    moving_body_m: np.ndarray,  # float64 [N, 3]: returns on movers, in the body frame at the picture's time
    depth_m: np.ndarray,  # float32 [H, W] optical z, NaN = unknown
    camera: Pinhole,
    T_body_camera: np.ndarray,
    step: int = 4,
) -> np.ndarray:
    """bool [H, W]: True where the picture shows a mover, up to 2.1 m above the floor.

    A pixel belongs to a mover if, at the distance of a moving return, it lies within 0.3 m to the side of
    it and its depth is within a stride of it or unknown, or within 9 cm and no surface is known before it.
    """
    mask = np.zeros(depth_m.shape, dtype=bool)
    if len(moving_body_m) == 0:
        return mask
    rays = camera.ray_grid()[::step, ::step] @ T_body_camera[:3, :3].T
    azimuth = np.arctan2(rays[..., 1], rays[..., 0])
    across = np.hypot(rays[..., 0], rays[..., 1])
    coarse = np.zeros(azimuth.shape, dtype=bool)
    small = depth_m[::step, ::step]
    for at, reach in zip(*azimuth_and_range(_in_company(moving_body_m), T_body_camera)):
        half, core = np.arctan2([_HALF_WIDTH_M, _CORE_M], max(float(reach), 0.2))
        apart = np.abs((azimuth - at + np.pi) % (2.0 * np.pi) - np.pi)
        z = reach / np.maximum(across, 1e-9)
        height = T_body_camera[2, 3] + rays[..., 2] * z
        upright = (height > -_FLOOR_M) & (height < HEIGHT_M)
        with np.errstate(invalid="ignore"):
            behind = small * across > reach + _DEPTH_M
            before = small * across < reach - _DEPTH_M
        # Depth made of still surfaces may lie behind a walker whom it did not notice: near the beams'
        # own azimuth the walker is believed, further off the depth is.
        coarse |= upright & (apart < half) & ~before & ((apart < core) | ~behind)
    grown = np.kron(coarse, np.ones((step, step), dtype=bool))[: mask.shape[0], : mask.shape[1]]
    mask[: grown.shape[0], : grown.shape[1]] = grown
    return _dilated(mask)


def _in_company(points_m: np.ndarray) -> np.ndarray:
    """The points [M, 3] that have others beside them on the floor plane, as two ankles do."""
    apart = np.linalg.norm(points_m[:, None, :2] - points_m[None, :, :2], axis=2)
    return points_m[np.count_nonzero(apart < _COMPANY_M, axis=1) >= _COMPANY]


def _dilated(mask: np.ndarray) -> np.ndarray:
    out = mask.copy()
    for axis in (0, 1):
        reach = out.copy()
        for shift in range(1, _SHADOW_PX + 1):
            for sign in (-shift, shift):
                moved = np.roll(out, sign, axis=axis)
                edge = np.s_[:sign] if sign > 0 else np.s_[sign:]
                moved[(edge,) if axis == 0 else (slice(None), edge)] = False
                reach |= moved
        out = reach
    return out
