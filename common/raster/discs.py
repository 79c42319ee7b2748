"""Discs on the surface that a depth map shows: how both mappers begin their Gaussians."""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, PARAMS, QUAT, SCALE

_REACH_PX = 2  # of the differences that give a normal
_SMOOTH = 0.05  # relative step of depth beyond which two pixels are not on one surface


def choose_pixels(
    wanted: np.ndarray,  # bool [H, W]: where a Gaussian may begin
    grey: np.ndarray,  # float32 [H, W] in [0, 1]
    stride_px: int,
    fine_stride_px: int,
    texture: float,  # mean absolute colour step (Sobel sums) that counts as texture
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u, v, spacing in px): a coarse lattice, and a fine one in cells where the colour changes."""
    h, w = wanted.shape
    change = np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)) + np.abs(cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    rough = cv2.blur(change, (stride_px + 1, stride_px + 1)) > np.float32(texture)
    out = []
    for step, here in ((stride_px, ~rough), (fine_stride_px, rough)):
        v, u = (a.ravel() for a in np.mgrid[step // 2 : h : step, step // 2 : w : step])
        cell_v = np.minimum(v // stride_px * stride_px + stride_px // 2, h - 1)
        cell_u = np.minimum(u // stride_px * stride_px + stride_px // 2, w - 1)
        chosen = wanted[v, u] & here[cell_v, cell_u]
        out.append(np.stack([u[chosen], v[chosen], np.full(chosen.sum(), step)]))
    u, v, spacing = np.concatenate(out, axis=1)
    # Neighbours in the picture become neighbours in memory: the kernels read visible Gaussians in order.
    order = np.lexsort((u // 32, v // 32))
    return u[order], v[order], spacing[order].astype(np.float64)


def make_discs(
    u: np.ndarray,  # int [N]
    v: np.ndarray,
    spacing_px: np.ndarray,  # [N] to their neighbours
    z_m: np.ndarray,  # float32 [H, W], 0 unknown; known at (u, v)
    rgb: np.ndarray,  # float32 [3, N] in [0, 1]
    camera: RasterCamera,
    T_map_camera: np.ndarray,
    *,
    size: float,  # standard deviation over spacing
    flatness: float,  # thickness over size
    opacity: float,
    least_slant: float,  # of the cosine to the normal: bounds how long a disc gets along a slope
) -> np.ndarray:
    """float32 [PARAMS, N]: as wide as the spacing, flat along the depth's normal, long down the slope."""
    z = z_m[v, u].astype(np.float64)
    points = _points(z_m, u, v, camera)
    normals = _normals(z_m, points, u, v, camera)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    slant = np.clip(np.abs(np.sum(normals * rays, axis=1)), least_slant, 1.0)
    across = size * spacing_px * z / camera.fx_px
    R = T_map_camera[:3, :3]
    out = np.empty((PARAMS, len(u)), np.float32)
    out[MEAN:SCALE] = (points @ R.T + T_map_camera[:3, 3]).T
    out[SCALE] = np.log(across / slant)  # along the slope a pixel covers more surface
    out[SCALE + 1] = np.log(across)
    out[SCALE + 2] = np.log(across * flatness)
    out[QUAT:OPACITY] = disc_quats(normals @ R.T, rays @ R.T).T
    out[OPACITY] = np.log(opacity / (1.0 - opacity))
    out[COLOUR:] = rgb
    return out


def _points(z_m: np.ndarray, u: np.ndarray, v: np.ndarray, camera: RasterCamera) -> np.ndarray:
    """float64 [N, 3] in the camera's frame."""
    z = z_m[v, u].astype(np.float64)
    return np.stack([(u - camera.cx_px) / camera.fx_px * z, (v - camera.cy_px) / camera.fy_px * z, z], axis=1)


def _normals(
    z_m: np.ndarray, points: np.ndarray, u: np.ndarray, v: np.ndarray, camera: RasterCamera
) -> np.ndarray:
    """Unit normals [N, 3] towards the camera by differences; the line of sight where the depth jumps."""
    h, w = z_m.shape
    here = z_m[v, u]

    def beside(du: int, dv: int) -> tuple[np.ndarray, np.ndarray]:
        uu, vv = np.clip(u + du, 0, w - 1), np.clip(v + dv, 0, h - 1)
        near = np.abs(z_m[vv, uu] - here) < _SMOOTH * here
        return _points(z_m, uu, vv, camera), near

    (right, a), (left, b) = beside(_REACH_PX, 0), beside(-_REACH_PX, 0)
    (down, c), (up, d) = beside(0, _REACH_PX), beside(0, -_REACH_PX)
    normal = np.cross(right - left, down - up)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    view = -points / np.linalg.norm(points, axis=1, keepdims=True)
    smooth = (a & b & c & d)[:, None] & (length > 1e-12)
    normal = np.where(smooth, normal / np.maximum(length, 1e-12), view)
    return np.where(np.sum(normal * view, axis=1, keepdims=True) < 0.0, -normal, normal)


def disc_quats(normals: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Quaternions (w, x, y, z) [N, 4] of discs: z along unit normals [N, 3], x down the slope seen by rays.

    The shortest turn that takes the z axis to the normal, after a turn about z that takes x to the slope.
    """
    n = np.where(normals[:, 2:] < -0.999, -normals, normals)  # a disc has two sides
    tilt = np.stack([1.0 + n[:, 2], -n[:, 1], n[:, 0]], axis=1)
    tilt /= np.linalg.norm(tilt, axis=1, keepdims=True)
    w, x, y = tilt.T
    # The ray in the tilted frame: its part in the disc's plane is the slope.
    along_x = (1 - 2 * y * y) * rays[:, 0] + 2 * x * y * rays[:, 1] - 2 * w * y * rays[:, 2]
    along_y = 2 * x * y * rays[:, 0] + (1 - 2 * x * x) * rays[:, 1] + 2 * w * x * rays[:, 2]
    half = 0.5 * np.arctan2(along_y, along_x)
    c, d = np.cos(half), np.sin(half)
    return np.stack([w * c, x * c + y * d, y * c - x * d, w * d], axis=1)
