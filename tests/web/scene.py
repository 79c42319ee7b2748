"""A seeded room of Gaussians for tests of the 3D viewer, and its renders by the CPU rasterizer."""

import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.messages.splat_codec import pack, unpack
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, PARAMS, QUAT, SCALE
from beamsplat.common.raster.rasterizer import Rasterizer

ROOM_M = (6.0, 5.0, 2.6)  # x, y, z; the map frame's origin is in a corner, on the floor
CAMERA = RasterCamera(277.0, 277.0, 161.3, 118.2, 320, 240)  # principal point beside the middle


def room(count=40_000, seed=3):
    """Return Gaussians float32 [14, count] on floor, ceiling, four walls and a block, with a seeded texture.

    They are flat, of any direction in their surface, 5 to 60 mm large, with opacities from 0.2 to 0.99.
    """
    rng = np.random.default_rng(seed)
    params = np.zeros((PARAMS, count), np.float32)
    surfaces = _surfaces()
    areas = np.array([np.linalg.norm(np.cross(u, v)) for _, u, v in surfaces])
    which = rng.choice(len(surfaces), count, p=areas / areas.sum())
    st = rng.uniform(size=(count, 2))
    for i, (corner, u, v) in enumerate(surfaces):
        on = which == i
        params[MEAN:SCALE, on] = (corner + st[on, :1] * u + st[on, 1:] * v).T
        params[QUAT:OPACITY, on] = _flat_rotations(np.cross(u, v), rng.uniform(0.0, 2.0 * np.pi, on.sum()))
    params[SCALE : SCALE + 2] = np.log(rng.uniform(0.005, 0.06, (2, count)))
    params[SCALE + 2] = np.log(0.002)
    opacity = rng.uniform(0.2, 0.99, count)
    params[OPACITY] = np.log(opacity / (1.0 - opacity))
    params[COLOUR:] = _texture(params[MEAN:SCALE], which, rng)
    return unpack(pack(params))  # what viewers get


def _surfaces():
    """Return (corner, edge u, edge v) of each rectangle, m."""
    x, y, z = np.diag(ROOM_M)
    o = np.zeros(3)
    block, low = np.array([3.5, 1.0, 0.0]), np.array([0.0, 0.0, 0.8])
    bx, by = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.2, 0.0])
    return [
        (o, x, y), (z, x, y), (o, x, z), (y, x, z), (o, y, z), (x, y, z),
        (block, bx, low), (block + by, bx, low), (block, by, low), (block + bx, by, low), (block + low, bx, by),
    ]  # fmt: skip


def _flat_rotations(normal, angle_rad):
    """Return quaternions wxyz [4, N] of rotations whose z axis is `normal`, turned about it."""
    n = normal / np.linalg.norm(normal)
    half = np.arccos(np.clip(n[2], -1.0, 1.0)) / 2.0
    axis = np.array([-n[1], n[0], 0.0])
    axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 1e-9 else np.array([1.0, 0.0, 0.0])
    w1, (x1, y1, z1) = np.cos(half), np.sin(half) * axis
    w2, z2 = np.cos(angle_rad / 2.0), np.sin(angle_rad / 2.0)
    return np.stack([w1 * w2 - z1 * z2, x1 * w2 + y1 * z2, y1 * w2 - x1 * z2, w1 * z2 + z1 * w2])


def _texture(means, which, rng):
    """Return colours [3, N]: one per surface, with checks of 0.5 m and noise."""
    base = rng.uniform(0.2, 0.8, (which.max() + 1, 3))[which].T
    checks = np.floor(means / 0.5 + 1e-3).sum(axis=0) % 2
    return np.clip(base + 0.15 * (checks - 0.5) + rng.normal(0.0, 0.05, base.shape), 0.0, 1.0)


def looking(eye_m, target_m):
    """Return T_map_camera [4, 4] of a camera without roll that looks from one point to another."""
    z = np.subtract(target_m, eye_m, dtype=float)
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye_m
    return T


def views(count, seed=5):
    """Return poses T_map_camera in the room, seeded."""
    rng = np.random.default_rng(seed)
    size = np.array(ROOM_M)
    eyes = rng.uniform([0.8, 2.5, 0.4], size - [0.8, 0.6, 0.6], (count, 3))
    targets = rng.uniform(0.15 * size, 0.85 * size, (count, 3))
    return [looking(e, t) for e, t in zip(eyes, targets, strict=True) if np.linalg.norm(e - t) > 0.3]


def rendered(params, T_map_camera, camera=CAMERA):
    """Return the render of the CPU rasterizer as uint8 [H, W, 3], RGB."""
    count = params.shape[1]
    padded = np.zeros((PARAMS, -(-count // 16) * 16), np.float32)
    padded[:, :count] = params
    rasterizer = Rasterizer(1)
    try:
        render = rasterizer.render(padded, count, camera, inverse(T_map_camera))
        rgb = np.clip(render.image[:3].transpose(1, 2, 0), 0.0, 1.0)
        return (rgb * 255.0 + 0.5).astype(np.uint8)
    finally:
        rasterizer.close()


def psnr_db(a, b):
    """Return the PSNR of two uint8 images."""
    return float(-10.0 * np.log10(np.mean((a.astype(float) - b.astype(float)) ** 2) / 255.0**2))
