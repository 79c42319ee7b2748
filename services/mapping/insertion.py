"""New Gaussians where the map does not explain a picture: discs on the surface that the depth shows."""

from __future__ import annotations

import cv2
import numpy as np

from common.raster.camera import RasterCamera
from common.raster.layout import COLOUR, MEAN, OPACITY, PARAMS, QUAT, SCALE
from services.mapping.keyframe import Level
from services.mapping.settings import MapperSettings


def unexplained(
    image: np.ndarray,  # float32 [5, H, W] as rendered
    level: Level,
    settings: MapperSettings,
) -> np.ndarray:
    """bool [H, W]: seen through, of another colour, or at another depth than a trusted measurement."""
    alpha = image[4]
    rgb = level.rgb.astype(np.float32) * np.float32(1 / 255)
    # Over a few pixels: thin edges that lie half a pixel off are for the optimiser, not for new Gaussians.
    colour_off = cv2.blur(np.abs(image[:3] - rgb).mean(axis=0), (5, 5)) > settings.colour_off
    depth = level.depth_mm.astype(np.float32) * np.float32(1e-3)
    expected = image[3] / np.maximum(alpha, 1e-3)
    trusted = level.depth_weight >= 128
    depth_off = (trusted & (np.abs(expected - depth) > settings.depth_off * depth)).astype(np.uint8)
    depth_off = cv2.erode(depth_off, np.ones((5, 5), np.uint8)) > 0
    return (alpha < settings.alpha_low) | colour_off | depth_off


def candidates(
    missing: np.ndarray, level: Level, settings: MapperSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u, v, spacing in px) of pixels of the level to turn into Gaussians: coarse, and fine on texture.

    A cell of `stride` holds one Gaussian, or four where the colour changes within it.
    """
    stride, fine = settings.stride_px, settings.fine_stride_px
    h, w = missing.shape
    grey = level.rgb.astype(np.float32).mean(axis=0) * np.float32(1 / 255)
    change = np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3)) + np.abs(
        cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3)
    )
    change = cv2.blur(change, (stride + 1, stride + 1)) * np.float32(stride / 8)
    out = []
    for step, wanted in ((stride, change <= settings.texture), (fine, change > settings.texture)):
        v, u = np.mgrid[step // 2 : h : step, step // 2 : w : step]
        v, u = v.ravel(), u.ravel()
        cell_v, cell_u = (
            np.minimum(v // stride * stride + stride // 2, h - 1),
            np.minimum(u // stride * stride + stride // 2, w - 1),
        )
        chosen = missing[v, u] & wanted[cell_v, cell_u] & (level.depth_mm[v, u] > 0)
        out.append(np.stack([u[chosen], v[chosen], np.full(chosen.sum(), step)]))
    u, v, spacing = np.concatenate(out, axis=1)
    # Neighbours in the picture become neighbours in memory: the kernels read visible Gaussians in order.
    order = np.lexsort((u // 32, v // 32))
    return u[order], v[order], spacing[order].astype(np.float64)


def make_gaussians(
    u: np.ndarray, v: np.ndarray, spacing_px: np.ndarray, level: Level, T_map_camera: np.ndarray,
    settings: MapperSettings,
) -> np.ndarray:  # fmt: skip
    """float32 [14, N] discs at pixels (u, v), as wide as the spacing, flat along the normal of the depth."""
    camera: RasterCamera = level.camera
    depth = level.depth_mm.astype(np.float64) * 1e-3
    z = depth[v, u]
    rays = np.stack(
        [(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, np.ones(len(u))], axis=1
    )
    points = rays * z[:, None]
    normals = _normals(depth, u, v, camera, rays)
    slant = np.clip(np.abs(np.sum(normals * rays, axis=1)) / np.linalg.norm(rays, axis=1), 0.35, 1.0)
    across = settings.size * spacing_px * z / camera.fx_px
    R_camera_disc = _frames(normals, rays)
    quat = _quats(T_map_camera[:3, :3] @ R_camera_disc)
    out = np.empty((PARAMS, len(u)), np.float32)
    out[MEAN : MEAN + 3] = (points @ T_map_camera[:3, :3].T + T_map_camera[:3, 3]).T
    out[SCALE] = np.log(across / slant)  # along the slope a pixel covers more surface
    out[SCALE + 1] = np.log(across)
    out[SCALE + 2] = np.log(across * settings.flatness)
    out[QUAT : QUAT + 4] = quat.T
    out[OPACITY] = np.log(settings.opacity / (1.0 - settings.opacity))
    out[COLOUR : COLOUR + 3] = level.rgb[:, v, u] * np.float32(1 / 255)
    return out


def _normals(
    depth: np.ndarray, u: np.ndarray, v: np.ndarray, camera: RasterCamera, rays: np.ndarray
) -> np.ndarray:
    """Unit normals [N, 3] towards the camera, by central differences; the view direction at depth jumps."""
    h, w = depth.shape
    reach = 2
    z = depth[v, u]

    def point(du: int, dv: int) -> tuple[np.ndarray, np.ndarray]:
        uu, vv = np.clip(u + du, 0, w - 1), np.clip(v + dv, 0, h - 1)
        d = depth[vv, uu]
        ok = (d > 0) & (np.abs(d - z) < 0.05 * z)
        ray = np.stack(
            [(uu - camera.cx_px) / camera.fx_px, (vv - camera.cy_px) / camera.fy_px, np.ones(len(u))], 1
        )
        return ray * d[:, None], ok

    (right, a), (left, b), (down, c), (up, d) = (
        point(reach, 0),
        point(-reach, 0),
        point(0, reach),
        point(0, -reach),
    )
    normal = np.cross(right - left, down - up)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    view = -rays / np.linalg.norm(rays, axis=1, keepdims=True)
    smooth = (a & b & c & d)[:, None] & (length > 1e-12)
    normal = np.where(smooth, normal / np.maximum(length, 1e-12), view)
    return np.where(np.sum(normal * view, axis=1, keepdims=True) < 0.0, -normal, normal)


def _frames(normals: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Rotations [N, 3, 3]: columns are the direction of the slope, across it, and the normal."""
    view = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    slope = view - normals * np.sum(view * normals, axis=1, keepdims=True)
    flat = np.linalg.norm(slope, axis=1, keepdims=True) < 1e-3
    helper = np.where(np.abs(normals[:, :1]) < 0.9, np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]]))
    slope = np.where(flat, helper - normals * np.sum(helper * normals, axis=1, keepdims=True), slope)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    return np.stack([slope, np.cross(normals, slope), normals], axis=2)


def _quats(R: np.ndarray) -> np.ndarray:
    """Quaternions (w, x, y, z) [N, 4] of rotations [N, 3, 3] (Shepperd: from the largest component)."""
    m = R
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    squares = np.stack(
        [1 + trace, 1 + 2 * m[:, 0, 0] - trace, 1 + 2 * m[:, 1, 1] - trace, 1 + 2 * m[:, 2, 2] - trace], 1
    )
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 1, 0] + m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] + m[:, 1, 2]
    options = np.stack([
        np.stack([squares[:, 0], wx, wy, wz], 1), np.stack([wx, squares[:, 1], xy, xz], 1),
        np.stack([wy, xy, squares[:, 2], yz], 1), np.stack([wz, xz, yz, squares[:, 3]], 1),
    ], 1)  # fmt: skip
    quat = options[np.arange(len(R)), np.argmax(squares, axis=1)]
    return quat / np.linalg.norm(quat, axis=1, keepdims=True)
