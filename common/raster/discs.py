"""Initial Gaussians from a depth map: flat discs (surfels) on the surface, for mapper and camera tracker."""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, PARAMS, QUAT, SCALE

_REACH_PX = 2  # distance of the neighbours whose differences give the normal
_SMOOTH = 0.05  # relative depth difference above which two pixels are not on the same surface


def choose_pixels(
    wanted: np.ndarray,  # bool [H, W]: pixels where a Gaussian may be created
    grey: np.ndarray,  # float32 [H, W] in [0, 1]
    stride_px: int,
    fine_stride_px: int,
    texture: float,  # threshold of the mean absolute image gradient (Sobel sums) of a textured cell
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Choose the pixels of new Gaussians: a coarse grid, and a fine grid in textured cells.

    Returns:
        u int [N] and v int [N]: columns and rows of the chosen pixels; and float64 [N]: the spacing (px) of
        the grid from which each pixel was chosen.
    """
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
    # Sort by blocks of 32 x 32 pixels: neighbours in the image become neighbours in memory, which the kernels
    # read in order.
    order = np.lexsort((u // 32, v // 32))
    return u[order], v[order], spacing[order].astype(np.float64)


def make_discs(
    u: np.ndarray,  # int [N]
    v: np.ndarray,
    spacing_px: np.ndarray,  # [N] distance to the neighbouring pixels of the grid
    z_m: np.ndarray,  # float32 [H, W] optical z, 0 = unknown; must be known at (u, v)
    rgb: np.ndarray,  # float32 [3, N] in [0, 1]
    camera: RasterCamera,
    T_map_camera: np.ndarray,
    *,
    size: float,  # standard deviation / spacing
    flatness: float,  # thickness / size
    opacity: float,
    least_slant: float,  # lower limit of the cosine between ray and normal: bounds the length of a disc
) -> np.ndarray:
    """Return disc-shaped Gaussians float32 [PARAMS, N] on the surface, one per pixel.

    A disc is flat along the surface normal, as wide as the spacing of the pixels, and elongated along the
    slope, so that discs cover a slanted surface without gaps.
    """
    z = z_m[v, u].astype(np.float64)
    points = _points(z_m, u, v, camera)
    normals = _normals(z_m, points, u, v, camera)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    slant = np.clip(np.abs(np.sum(normals * rays, axis=1)), least_slant, 1.0)
    across = size * spacing_px * z / camera.fx_px
    R = T_map_camera[:3, :3]
    out = np.empty((PARAMS, len(u)), np.float32)
    out[MEAN:SCALE] = (points @ R.T + T_map_camera[:3, 3]).T
    out[SCALE] = np.log(across / slant)  # along the slope, a pixel covers more of the surface
    out[SCALE + 1] = np.log(across)
    out[SCALE + 2] = np.log(across * flatness)
    out[QUAT:OPACITY] = disc_quats(normals @ R.T, rays @ R.T).T
    out[OPACITY] = np.log(opacity / (1.0 - opacity))
    out[COLOUR:] = rgb
    return out


def _points(z_m: np.ndarray, u: np.ndarray, v: np.ndarray, camera: RasterCamera) -> np.ndarray:
    """Return the points float64 [N, 3] at pixels (u, v) in the camera frame."""
    z = z_m[v, u].astype(np.float64)
    return np.stack([(u - camera.cx_px) / camera.fx_px * z, (v - camera.cy_px) / camera.fy_px * z, z], axis=1)


def _normals(
    z_m: np.ndarray, points: np.ndarray, u: np.ndarray, v: np.ndarray, camera: RasterCamera
) -> np.ndarray:
    """Return unit normals [N, 3] towards the camera, from differences of neighbouring points.

    At a depth discontinuity the normal is the direction to the camera.
    """
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
    """Return the orientations of discs as quaternions (w, x, y, z) [N, 4].

    The z axis is along the unit normal [N, 3], the x axis along the projection of the ray [N, 3] to the
    disc's plane (the slope). The quaternion is a rotation about z, followed by the shortest rotation from z
    to the normal.
    """
    n = np.where(normals[:, 2:] < -0.999, -normals, normals)  # a disc has two equivalent normals
    tilt = np.stack([1.0 + n[:, 2], -n[:, 1], n[:, 0]], axis=1)
    tilt /= np.linalg.norm(tilt, axis=1, keepdims=True)
    w, x, y = tilt.T
    # Components of the ray in the disc's plane, in the tilted frame.
    along_x = (1 - 2 * y * y) * rays[:, 0] + 2 * x * y * rays[:, 1] - 2 * w * y * rays[:, 2]
    along_y = 2 * x * y * rays[:, 0] + (1 - 2 * x * x) * rays[:, 1] + 2 * w * x * rays[:, 2]
    half = 0.5 * np.arctan2(along_y, along_x)
    c, d = np.cos(half), np.sin(half)
    return np.stack([w * c, x * c + y * d, y * c - x * d, w * d], axis=1)
