"""Multi-view depth by plane sweep (Collins 1996)."""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.raster.camera import RasterCamera

_PLANES = 48
_PATCH_PX = (7, 7)
_MAX_GREY_ERROR = 0.12  # grey differences are clipped here (robust cost)
_MAX_COST_RATIO = 0.8  # cost of the best plane over the cost of the best plane elsewhere
_MIN_CONTRAST = 0.012  # mean absolute grey deviation within a patch


def sweep(
    grey: np.ndarray,  # float32 [h, w]
    others: list[tuple[np.ndarray, np.ndarray]],  # (grey float32 [h, w], T_other_here [4, 4])
    camera: RasterCamera,
    nearest: float,
    farthest: float,
) -> np.ndarray:
    """Return the optical z float32 [h, w] of the image `grey`, 0 where the depth is ambiguous.

    z and its limits `nearest` and `farthest` have the unit of the poses. The plane z = d maps a pixel of this
    image to a pixel of another image by the homography K (R + t n^T / d) K^-1, with n = (0, 0, 1) and
    (R, t) = T_other_here.
    """
    h, w = grey.shape
    K = np.array(
        [[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1.0]], dtype=np.float64
    )
    K_inverse = np.linalg.inv(K)
    inverse_z = np.linspace(1.0 / farthest, 1.0 / nearest, _PLANES)
    cost = np.zeros((_PLANES, h, w), np.float32)
    seen = np.zeros((_PLANES, h, w), np.float32)
    ones = np.ones((h, w), np.float32)
    for other, T_other_here in others:
        for i, q in enumerate(inverse_z):
            lift = T_other_here[:3, :3] + np.outer(T_other_here[:3, 3], [0.0, 0.0, q])
            H = K @ lift @ K_inverse
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            warped = cv2.warpPerspective(other, H, (w, h), flags=flags)
            valid = cv2.warpPerspective(ones, H, (w, h), flags=flags)
            cost[i] += np.minimum(np.abs(warped - grey), _MAX_GREY_ERROR) * valid
            seen[i] += valid
    cost = np.where(seen > 0.5, cost / np.maximum(seen, 0.5), _MAX_GREY_ERROR).astype(np.float32)
    for plane in cost:
        cv2.blur(plane, _PATCH_PX, dst=plane)
    best = cost.argmin(axis=0)
    least = np.take_along_axis(cost, best[None], axis=0)[0]
    away = np.abs(np.arange(_PLANES)[:, None, None] - best[None]) > 3
    second = np.where(away, cost, _MAX_GREY_ERROR).min(axis=0)
    contrast = cv2.blur(np.abs(grey - cv2.blur(grey, _PATCH_PX)), _PATCH_PX)
    good = (least < _MAX_COST_RATIO * second) & (contrast > _MIN_CONTRAST) & (best > 0) & (best < _PLANES - 1)
    return np.where(good, 1.0 / _subplane_inverse_z(inverse_z, cost, best), 0.0).astype(np.float32)


def _subplane_inverse_z(inverse_z: np.ndarray, cost: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Return the inverse depth at the minimum of a parabola through the costs of three planes, per pixel."""
    inner = np.clip(best, 1, len(inverse_z) - 2)
    a, b, c = (np.take_along_axis(cost, (inner + k)[None], axis=0)[0] for k in (-1, 0, 1))
    bend = np.maximum(a - 2.0 * b + c, 1e-6)
    shift = np.clip(0.5 * (a - c) / bend, -0.5, 0.5)
    return inverse_z[inner] + shift * (inverse_z[1] - inverse_z[0])


def fill_unknown(z: np.ndarray, sigma_px: float) -> np.ndarray:
    """Fill unknown pixels (0) of a depth map float32 [h, w] with blurred inverse depth (sigma `sigma_px`)."""
    known = (z > 0.0).astype(np.float32)
    if not known.any():
        return z
    q = np.where(z > 0.0, 1.0 / np.maximum(z, 1e-6), 0.0).astype(np.float32)
    out, weight = np.zeros_like(q), np.zeros_like(q)
    for reach in (1.0, 3.0, 9.0):  # near neighbours dominate; far ones count where there are no others
        factor = np.float32(0.02 ** (np.log(reach) / np.log(3.0)))
        out += factor * cv2.GaussianBlur(q, (0, 0), sigma_px * reach)
        weight += factor * cv2.GaussianBlur(known, (0, 0), sigma_px * reach)
    mean_q = float(q[known > 0].mean())
    spread = (out + 1e-6 * mean_q) / (weight + 1e-6)
    return np.where(z > 0.0, z, 1.0 / np.maximum(spread, 1e-6)).astype(np.float32)
