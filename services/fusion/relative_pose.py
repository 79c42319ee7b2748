"""Relative pose of two images, refined on tracked corners with a prior from localization.

An error of 0.1 degrees of yaw is about one pixel; at a short baseline this is a depth error of 10 %. The
epipolar constraint determines the relative rotation and the direction of the translation; the metric prior
determines the length of the translation.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import skew, so3_exp

# Parameters of pyramidal Lucas-Kanade tracking.
_LK: dict[str, Any] = {"winSize": (13, 13), "maxLevel": 3, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
MIN_TRACKS = 12  # fewer tracks do not refine a pose


def detect_corners(grey: np.ndarray, most: int = 150) -> np.ndarray:
    """Return up to `most` corners (u, v) of an image uint8 [H, W], strongest first (Shi-Tomasi).

    Returns:
        float32 [N, 2].
    """
    found = cv2.goodFeaturesToTrack(grey, most, 0.01, 8)
    return np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)


def track_corners(
    grey: np.ndarray, other: np.ndarray, uv: np.ndarray, predicted: np.ndarray, tolerance_px: float = 0.4
) -> tuple[np.ndarray, np.ndarray]:
    """Track points from `grey` to `other` by Lucas-Kanade, forward and backward.

    Args:
        grey, other: uint8 [H, W].
        uv: float32 [N, 2], points in `grey`.
        predicted: float32 [N, 2], start values in `other`.
        tolerance_px: largest difference of a point and its backward track.

    Returns:
        Points in `other` float32 [N, 2], and bool [N]: tracked in both directions.
    """
    if len(uv) == 0:
        return uv.copy(), np.zeros(0, dtype=bool)
    start = np.ascontiguousarray(predicted, dtype=np.float32)[:, None]
    there, found, _ = cv2.calcOpticalFlowPyrLK(grey, other, uv[:, None], start.copy(), **_LK)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(other, grey, there, uv[:, None].copy(), **_LK)
    same = np.abs(back[:, 0] - uv).max(axis=1) < tolerance_px
    return there[:, 0], same & (found[:, 0] > 0) & (found_back[:, 0] > 0)


def refine_relative_pose(
    T_b_a: np.ndarray,  # float64 [4, 4], camera a to camera b, from localization
    rays_a: np.ndarray,  # float64 [N, 3] with z = 1
    rays_b: np.ndarray,  # float64 [N, 3] of the same corners
    focal_px: float,
    rotation_sigma_rad: float,
    translation_sigma_m: float,
    pixel_sigma: float = 0.4,
    iterations: int = 6,
) -> np.ndarray:
    """Return the maximum a posteriori `T_b_a` [4, 4], by Gauss-Newton on epipolar distances and prior.

    Args:
        T_b_a: the prior from localization; takes points of camera frame a to camera frame b.
        rays_a, rays_b: float64 [N, 3] with z = 1, of the same corners in both images.
        focal_px: converts the distances to pixels.
        rotation_sigma_rad, translation_sigma_m: standard deviations of the prior, per axis.
        pixel_sigma: standard deviation of a corner, px.
        iterations: number of Gauss-Newton steps.
    """
    prior = np.diag([1.0 / rotation_sigma_rad**2] * 3 + [1.0 / translation_sigma_m**2] * 3)
    x = np.zeros(6)

    def moved(x: np.ndarray) -> np.ndarray:
        T = T_b_a.copy()
        T[:3, :3] = so3_exp(x[:3]) @ T_b_a[:3, :3]
        T[:3, 3] += x[3:]
        return T

    for _ in range(iterations):
        r = epipolar_px(moved(x), rays_a, rays_b, focal_px)
        J = np.empty((len(r), 6))
        for k in range(6):
            step = np.zeros(6)
            step[k] = 1e-6
            J[:, k] = (epipolar_px(moved(x + step), rays_a, rays_b, focal_px) - r) / 1e-6
        scale = max(pixel_sigma, 1.4826 * float(np.median(np.abs(r))))
        weight = 1.0 / (1.0 + (r / scale) ** 2) ** 2 / pixel_sigma**2
        H = J.T @ (J * weight[:, None]) + prior
        delta = np.linalg.solve(H, J.T @ (weight * r) + prior @ x)
        x -= delta
        if np.abs(delta).max() < 1e-6:
            break
    return moved(x)


def epipolar_px(T_b_a: np.ndarray, rays_a: np.ndarray, rays_b: np.ndarray, focal_px: float) -> np.ndarray:
    """Return signed distances [N], pixels, of the rays in b from the epipolar lines of the rays in a."""
    baseline = T_b_a[:3, 3]
    E = skew(baseline / max(float(np.linalg.norm(baseline)), 1e-9)) @ T_b_a[:3, :3]
    lines = rays_a @ E.T
    return np.sum(lines * rays_b, axis=1) / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-12) * focal_px


def refine_from_images(
    T_b_a: np.ndarray,
    grey_a: np.ndarray,  # uint8 [H, W]
    grey_b: np.ndarray,  # uint8 [H, W]
    uv_a: np.ndarray,  # float32 [N, 2] corners of a
    camera: Pinhole,  # of this size, without distortion
    initial_depth_m: float,
    rotation_sigma_rad: float,
    translation_sigma_m: float,
) -> np.ndarray:
    """Track corners from image a to b and return the refined `T_b_a`; unchanged if too few are tracked.

    See `refine_relative_pose`. `initial_depth_m`: depth with which the positions of corners in b are
    predicted.
    """
    if len(uv_a) < MIN_TRACKS:
        return T_b_a
    rays_a = camera.rays(uv_a)
    predicted, _ = camera.project(initial_depth_m * rays_a @ T_b_a[:3, :3].T + T_b_a[:3, 3])
    predicted = np.where(np.isfinite(predicted), predicted, uv_a)
    uv_b, good = track_corners(grey_a, grey_b, uv_a, predicted)
    if good.sum() < MIN_TRACKS:
        return T_b_a
    return refine_relative_pose(
        T_b_a, rays_a[good], camera.rays(uv_b[good]), camera.fx_px, rotation_sigma_rad, translation_sigma_m
    )
