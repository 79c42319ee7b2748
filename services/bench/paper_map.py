"""How good a run's map is at views off the path: the map as it was sent, placed by the first pose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from common.geometry import inverse
from common.raster.camera import RasterCamera
from common.raster.layout import PARAMS
from common.raster.rasterizer import Rasterizer
from common.splats import unpack
from services.bench.paper_live import Seen
from services.bench.paper_score import Truth
from services.mapping.dataset import ExtraView, extra_views, read_depth_png
from services.mapping.scores import render_rgb_depth, score_view
from services.mapping.store import GaussianStore, moved


def assembled(seen: Seen) -> GaussianStore:
    """All chunks of a run in the map frame."""
    store = GaussianStore()
    for chunk in seen.chunks.values():
        if chunk.count:
            store.append(moved(unpack(chunk.packed), chunk.T_map_anchor).astype(np.float32), chunk.anchor_id)
    return store


def map_figures(
    seen: Seen, truth: Truth, T_world_map: np.ndarray | None
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """PSNR, SSIM and depth at the recording's views off the path; and (truth, render) pictures of some."""
    store = assembled(seen)
    figures: dict[str, Any] = {"gaussians": store.count}
    views: list[ExtraView] = extra_views(truth.path / "extra_views")
    if not store.count or T_world_map is None or not views:
        return figures, []
    p = truth.drive.undistort.pinhole
    camera = RasterCamera(p.fx_px, p.fy_px, p.cx_px, p.cy_px, p.width_px, p.height_px)
    rasterizer, scores, pictures = Rasterizer(), [], []
    for number, view in enumerate(views):
        true_rgb = cv2.cvtColor(cv2.imread(str(view.image_file)), cv2.COLOR_BGR2RGB)
        T_map_camera = inverse(T_world_map) @ view.T_map_camera
        rgb, depth, _ = render_rgb_depth(rasterizer, store, camera, T_map_camera)
        scores.append(score_view(rgb, depth, true_rgb, read_depth_png(view.depth_file)))
        if number % max(len(views) // 3, 1) == 0 and len(pictures) < 3:
            pictures.append(np.hstack([true_rgb, (rgb * 255.0 + 0.5).astype(np.uint8)]))
    rasterizer.close()
    figures |= {
        "psnr_offpath_db": float(np.mean([s.psnr_db for s in scores])),
        "ssim_offpath": float(np.mean([s.ssim for s in scores])),
        "depth_l1_offpath_m": float(np.mean([s.depth_l1_m for s in scores])),
    }
    return figures, pictures


def seen_from_above(seen: Seen, T_world_map: np.ndarray, step: int = 4) -> np.ndarray:
    """float32 [N, 5] of the Gaussians between floor and ceiling: x, y (m, world), red, green, blue."""
    store = assembled(seen)
    if not store.count:
        return np.zeros((0, 5), np.float32)
    params = moved(store.params[:PARAMS, : store.count], T_world_map)
    chosen = (params[2] > 0.1) & (params[2] < 1.8)
    rows = np.concatenate([params[0:2], params[11:14]])[:, chosen]
    return rows.T[::step].astype(np.float32)


def previews(seen: Seen, most: int) -> list[tuple[int, bytes]]:
    """(stamp, JPEG of the render) of some keyframes, evenly over the drive."""
    if not seen.previews:
        return []
    picked = np.unique(np.linspace(0, len(seen.previews) - 1, most).round().astype(int))
    return [(seen.previews[i][0], seen.previews[i][2]) for i in picked]


def truth_folder(data: Path) -> Path:
    """The folder that holds bag/ and its truth: `data`, or the one around a bag."""
    return data if (data / "bag").exists() or (data / "groundtruth.txt").exists() else data.parent
