"""Quality of a map: PSNR, SSIM and depth error of views, F-score of the surface against ground truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.rasterizer import Rasterizer, expected_depth
from beamsplat.common.raster.ssim import ssim

GRID_M = 0.02  # cell of the fused surface; fixed by the evaluation protocol
FSCORE_DISTANCE_M = 0.05  # largest distance of a matching point; fixed by the evaluation protocol


@dataclass(frozen=True)
class ViewScore:
    """Image quality and depth error of one rendered view at full image size."""

    psnr_db: float
    ssim: float
    depth_l1_m: float  # mean; per pixel at most the true depth; NaN without ground truth


def render_rgb_depth(
    rasterizer: Rasterizer, store: GaussianStore, camera: RasterCamera, T_map_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (rgb float32 [H, W, 3] in [0, 1], expected optical z float32 [H, W] m, alpha float32 [H, W])."""
    render = rasterizer.render(store.params, store.count, camera, inverse(T_map_camera))
    out = rgb_depth_alpha(render.image)
    rasterizer.release(render)
    return out


def rgb_depth_alpha(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return copies of colour, expected depth and alpha of a render float32 [5, H, W].

    Returns:
        As `render_rgb_depth`.
    """
    rgb = np.clip(image[:3].transpose(1, 2, 0), 0.0, 1.0).copy()
    return rgb, expected_depth(image), image[4].copy()


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    """Return the PSNR (dB) between two images with values in [0, 1]; 120 dB if they are equal."""
    return float(-10.0 * np.log10(max(float(np.mean((a - b) ** 2)), 1e-12)))


def score_view(
    rgb: np.ndarray, depth: np.ndarray, true_rgb: np.ndarray, true_depth: np.ndarray | None
) -> ViewScore:
    """Return PSNR, SSIM and depth error of a rendered view, compared with camera image and true depth.

    Args:
        rgb: rendered image, float32 [H, W, 3] in [0, 1].
        depth: rendered optical z, float32 [H, W] in metres, NaN = unknown.
        true_rgb: camera image, uint8 [H, W, 3].
        true_depth: true optical z, as `depth`; None = no ground truth.
    """
    truth = true_rgb.astype(np.float32) / 255.0
    l1 = float("nan")
    if true_depth is not None:
        known = np.isfinite(true_depth)
        shown = np.where(np.isfinite(depth[known]), depth[known], 0.0)
        l1 = float(np.mean(np.minimum(np.abs(shown - true_depth[known]), true_depth[known])))
    return ViewScore(psnr_db(rgb, truth), ssim(rgb, truth), l1)


def fused_surface(
    render: Callable[[RasterCamera, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]],
    views: Iterable[tuple[RasterCamera, np.ndarray]],
) -> np.ndarray:
    """Return the surface of the map as points float64 [N, 3] (m) in the map frame, one per 2 cm cell.

    The points are computed from the depth rendered at `views` (camera, T_map_camera) where alpha > 0.5.
    `render` returns colour, depth and alpha of the map at a view, as `render_rgb_depth`.
    """
    parts = []
    for camera, T_map_camera in views:
        _, depth, alpha = render(camera, T_map_camera)
        v, u = np.nonzero((alpha > 0.5) & np.isfinite(depth))
        z = depth[v, u].astype(np.float64)
        rays = np.stack(
            [(u - camera.cx_px) / camera.fx_px * z, (v - camera.cy_px) / camera.fy_px * z, z], axis=1
        )
        points = rays @ T_map_camera[:3, :3].T + T_map_camera[:3, 3]
        parts.append(np.unique(np.floor(points / GRID_M).astype(np.int64), axis=0))
    if not parts:
        return np.zeros((0, 3))
    return (np.unique(np.concatenate(parts), axis=0) + 0.5) * GRID_M


def f_score(points: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Compare the map's surface points [N, 3] with true points [M, 3], both in metres.

    Returns:
        `accuracy_m`: mean distance from a map point to the nearest true point; `completion_m`: mean distance
        from a true point to the nearest map point (distances clipped to 1 m); `fscore_5cm`: F-score of the
        points nearer than 5 cm.
    """
    if len(points) == 0 or len(truth) == 0:
        return {"fscore_5cm": 0.0, "accuracy_m": float("nan"), "completion_m": float("nan")}
    to_truth, _ = cKDTree(truth).query(points, distance_upper_bound=1.0)
    to_map, _ = cKDTree(points).query(truth, distance_upper_bound=1.0)
    to_truth, to_map = np.minimum(to_truth, 1.0), np.minimum(to_map, 1.0)
    precision, recall = (
        float(np.mean(to_truth < FSCORE_DISTANCE_M)),
        float(np.mean(to_map < FSCORE_DISTANCE_M)),
    )
    score = 2.0 * precision * recall / max(precision + recall, 1e-12)
    return {"fscore_5cm": score, "accuracy_m": float(to_truth.mean()), "completion_m": float(to_map.mean())}
