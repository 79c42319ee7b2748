"""Score the map that the mapper published in a live run, at held-out views off the path."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.common.mapfiles.ply import read_ply_points
from beamsplat.common.mapfiles.scores import ViewScore, f_score, fused_surface, render_rgb_depth, score_view
from beamsplat.common.mapfiles.store import GaussianStore, transform_gaussians
from beamsplat.common.messages.splat_codec import unpack
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.tools.evaluation.dataset import OffPathView, read_depth_png, read_offpath_views
from beamsplat.tools.report.observer import RunRecord
from beamsplat.tools.report.scores import GroundTruth
from beamsplat.tools.report.top_view import top_view

_AT_VIEWS = {
    "psnr_offpath_db": "psnr_db", "ssim_offpath": "ssim", "depth_l1_offpath_m": "depth_l1_m",
}  # fmt: skip


def assemble_map(chunks: dict[int, Any]) -> GaussianStore:
    """Return one map in the map frame, made of map chunks (messages of `mapping/chunk`) by anchor id."""
    store = GaussianStore()
    for chunk in chunks.values():
        if chunk.count:
            store.add(
                transform_gaussians(unpack(chunk.packed), chunk.T_map_anchor).astype(np.float32),
                chunk.anchor_id,
            )
    return store


def map_figures(
    record: RunRecord, truth: GroundTruth, T_world_map: np.ndarray
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Return the scores of the map of a live run at held-out views, and images of some of these views.

    Names without a prefix are scores of the map at the end of the drive. Names with the prefix `refined_` are
    scores of the map at the end of the run, if refinement has changed it.

    Args:
        T_world_map: rigid alignment of the map with the ground truth, without scale, float64 [4, 4].

    Returns:
        Scores by name, and RGB images uint8 [H, 2 W, 3]: the true image on the left, the render of the last
        map on the right.
    """
    figures, images = _score(record.online_chunks or record.chunks, record, truth, T_world_map)
    if record.online_chunks is not None and _revisions(record.online_chunks) != _revisions(record.chunks):
        refined, images = _score(record.chunks, record, truth, T_world_map)
        figures |= {f"refined_{name}": value for name, value in refined.items()}
    return figures, images


def _revisions(chunks: dict[int, Any]) -> dict[int, int]:
    return {anchor: chunk.revision for anchor, chunk in chunks.items()}


def _score(
    chunks: dict[int, Any], record: RunRecord, truth: GroundTruth, T_world_map: np.ndarray
) -> tuple[dict[str, Any], list[np.ndarray]]:
    store = assemble_map(chunks)
    figures: dict[str, Any] = {"gaussians": store.count}
    if not store.count:
        return figures, []
    p = truth.drive.undistort.pinhole
    camera = RasterCamera(p.fx_px, p.fy_px, p.cx_px, p.cy_px, p.width_px, p.height_px)
    rasterizer = Rasterizer()
    views: list[OffPathView] = read_offpath_views(truth.path / "extra_views")
    scores: list[ViewScore] = []
    images: list[np.ndarray] = []
    for number, view in enumerate(views):
        true_bgr = cv2.imread(str(view.image_file))
        assert true_bgr is not None  # written by the simulator
        true_rgb = cv2.cvtColor(true_bgr, cv2.COLOR_BGR2RGB)
        T_map_camera = inverse(T_world_map) @ view.T_map_camera
        rgb, depth, _ = render_rgb_depth(rasterizer, store, camera, T_map_camera)
        scores.append(score_view(rgb, depth, true_rgb, read_depth_png(view.depth_file)))
        if number % max(len(views) // 3, 1) == 0 and len(images) < 3:
            images.append(np.hstack([true_rgb, (rgb * 255.0 + 0.5).astype(np.uint8)]))
    for key, name in _AT_VIEWS.items() if scores else ():
        figures[key] = float(np.mean([getattr(s, name) for s in scores]))
    surface = truth.path / "gt_surface.ply"
    if surface.is_file() and record.keyframe_poses is not None:
        half = camera.resized(camera.width_px // 2, camera.height_px // 2)
        poses = [(half, T @ truth.drive.T_body_camera) for T in record.keyframe_poses]
        points = transform_points(
            T_world_map, fused_surface(partial(render_rgb_depth, rasterizer, store), poses)
        )
        figures |= f_score(points, read_ply_points(surface))
    rasterizer.close()
    return figures, images


def top_view_of_map(record: RunRecord, T_world_map: np.ndarray, path_m: np.ndarray) -> np.ndarray | None:
    """Return an image BGR uint8 [H, W, 3] of the map from above, without ceiling; None if the map is empty.

    Args:
        T_world_map: alignment of the map with the ground truth, float64 [4, 4].
        path_m: x, y of the path that is drawn on the image, float64 [K, >= 2], world frame.
    """
    params = map_in_world(record, T_world_map)
    return None if params is None else top_view(params, path_m)


def map_in_world(record: RunRecord, T_world_map: np.ndarray) -> np.ndarray | None:
    """Return the last map of a run as Gaussians float32 [14, N] in the world frame; None if it is empty.

    Args:
        T_world_map: alignment of the map with the ground truth, float64 [4, 4].
    """
    store = assemble_map(record.chunks)
    if not store.count:
        return None
    return transform_gaussians(store.params[:, : store.count], T_world_map).astype(np.float32)


def previews(record: RunRecord, most: int) -> list[tuple[int, bytes]]:
    """Return (stamp in ns, JPEG of the rendered map) at up to `most` keyframes, evenly over the drive."""
    if not record.previews:
        return []
    picked = np.unique(np.linspace(0, len(record.previews) - 1, most).round().astype(int))
    return [(record.previews[i][0], record.previews[i][2]) for i in picked]


def truth_folder(data: Path) -> Path:
    """Return the folder that contains bag/ and its ground truth: `data`, or the parent folder of a bag."""
    return data if (data / "bag").exists() or (data / "groundtruth.txt").exists() else data.parent
