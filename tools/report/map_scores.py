"""How good a run's map is at views off the path: the map as it was sent, placed by the first pose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.common.mapfiles.ply import read_ply_points
from beamsplat.common.mapfiles.scores import f_score, fused_surface, render_rgb_depth, score_view
from beamsplat.common.mapfiles.store import GaussianStore, moved
from beamsplat.common.messages.splat_codec import unpack
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.tools.evaluation.dataset import ExtraView, extra_views, read_depth_png
from beamsplat.tools.report.observer import Seen
from beamsplat.tools.report.scores import Truth
from beamsplat.tools.report.top_view import top_view

_AT_VIEWS = {
    "psnr_offpath_db": "psnr_db", "ssim_offpath": "ssim", "depth_l1_offpath_m": "depth_l1_m",
}  # fmt: skip


def assembled(chunks: dict[int, Any]) -> GaussianStore:
    """Chunks by anchor as one map, in the map frame."""
    store = GaussianStore()
    for chunk in chunks.values():
        if chunk.count:
            store.add(moved(unpack(chunk.packed), chunk.T_map_anchor).astype(np.float32), chunk.anchor_id)
    return store


def map_figures(seen: Seen, truth: Truth, T_world_map: np.ndarray) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Figures of the map as the drive left it and, prefixed `refined_`, as it ended; pictures of the latter.

    `T_world_map` places the map: the rigid offset of all poses, no scale. Pictures are (truth, render).
    """
    figures, pictures = _scored(seen.online_chunks or seen.chunks, seen, truth, T_world_map)
    if seen.online_chunks is not None and _revisions(seen.online_chunks) != _revisions(seen.chunks):
        refined, pictures = _scored(seen.chunks, seen, truth, T_world_map)
        figures |= {f"refined_{name}": value for name, value in refined.items()}
    return figures, pictures


def _revisions(chunks: dict[int, Any]) -> dict[int, int]:
    return {anchor: chunk.revision for anchor, chunk in chunks.items()}


def _scored(
    chunks: dict[int, Any], seen: Seen, truth: Truth, T_world_map: np.ndarray
) -> tuple[dict[str, Any], list[np.ndarray]]:
    store = assembled(chunks)
    figures: dict[str, Any] = {"gaussians": store.count}
    if not store.count:
        return figures, []
    p = truth.drive.undistort.pinhole
    camera = RasterCamera(p.fx_px, p.fy_px, p.cx_px, p.cy_px, p.width_px, p.height_px)
    rasterizer = Rasterizer()
    views: list[ExtraView] = extra_views(truth.path / "extra_views")
    scores, pictures = [], []
    for number, view in enumerate(views):
        true_rgb = cv2.cvtColor(cv2.imread(str(view.image_file)), cv2.COLOR_BGR2RGB)
        T_map_camera = inverse(T_world_map) @ view.T_map_camera
        rgb, depth, _ = render_rgb_depth(rasterizer, store, camera, T_map_camera)
        scores.append(score_view(rgb, depth, true_rgb, read_depth_png(view.depth_file)))
        if number % max(len(views) // 3, 1) == 0 and len(pictures) < 3:
            pictures.append(np.hstack([true_rgb, (rgb * 255.0 + 0.5).astype(np.uint8)]))
    for key, name in _AT_VIEWS.items() if scores else ():
        figures[key] = float(np.mean([getattr(s, name) for s in scores]))
    surface = truth.path / "gt_surface.ply"
    if surface.is_file() and seen.keyframe_poses is not None:
        half = camera.resized(camera.width_px // 2, camera.height_px // 2)
        poses = [(half, T @ truth.drive.T_body_camera) for T in seen.keyframe_poses]
        points = transform_points(T_world_map, fused_surface(rasterizer, store, poses))
        figures |= f_score(points, read_ply_points(surface))
    rasterizer.close()
    return figures, pictures


def map_from_above(seen: Seen, T_world_map: np.ndarray, path_m: np.ndarray) -> np.ndarray | None:
    """uint8 BGR picture of the map without its ceiling, and of a path [K, >= 2] in the world on it."""
    store = assembled(seen.chunks)
    if not store.count:
        return None
    return top_view(moved(store.params[:, : store.count], T_world_map).astype(np.float32), path_m)


def previews(seen: Seen, most: int) -> list[tuple[int, bytes]]:
    """(stamp, JPEG of the render) of some keyframes, evenly over the drive."""
    if not seen.previews:
        return []
    picked = np.unique(np.linspace(0, len(seen.previews) - 1, most).round().astype(int))
    return [(seen.previews[i][0], seen.previews[i][2]) for i in picked]


def truth_folder(data: Path) -> Path:
    """The folder that holds bag/ and its truth: `data`, or the one around a bag."""
    return data if (data / "bag").exists() or (data / "groundtruth.txt").exists() else data.parent
