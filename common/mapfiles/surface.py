"""The surface of a map as coloured points: depth rendered from all keyframes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.mapfiles.scores import render_rgb_depth
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.rasterizer import Rasterizer

_MAX_DEPTH_STEP = 0.05  # relative step between neighbours, above which a pixel may be between two surfaces
_MIN_ALPHA = 0.8  # pixels with less are seen through
_MAX_WAITING_ROWS = 1_000_000  # points kept before they are merged: bounds the memory


@dataclass(frozen=True)
class RenderedDepth:
    """An image and a depth map, rendered from the map at one camera pose."""

    camera: RasterCamera
    T_map_camera: np.ndarray
    rgb: np.ndarray  # float32 [H, W, 3] in [0, 1]
    depth_m: np.ndarray  # float32 [H, W] optical z, NaN where it is uncertain


def render_depth_views(
    store: GaussianStore, views: Iterable[tuple[RasterCamera, np.ndarray]], threads: int = 1
) -> Iterator[RenderedDepth]:
    """Render colour and depth of the map from each (camera, T_map_camera), at half the image size.

    Transparent pixels and pixels of `flying_pixels` have no depth (NaN).
    """
    rasterizer = Rasterizer(threads)
    try:
        for camera, T_map_camera in views:
            half = camera.resized(camera.width_px // 2, camera.height_px // 2)
            rgb, depth, alpha = render_rgb_depth(rasterizer, store, half, T_map_camera)
            sure = (alpha > _MIN_ALPHA) & np.isfinite(depth) & ~flying_pixels(depth)
            yield RenderedDepth(half, T_map_camera, rgb, np.where(sure, depth, np.float32(np.nan)))
    finally:
        rasterizer.close()


def flying_pixels(depth: np.ndarray) -> np.ndarray:
    """Return a mask bool [H, W] of the pixels next to a depth step: they may be averages of two surfaces."""
    out = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(depth, axis=axis)) > _MAX_DEPTH_STEP * np.minimum(
            *(np.take(depth, range(i, depth.shape[axis] - 1 + i), axis=axis) for i in (0, 1))
        )
        before = [slice(None)] * 2
        after = [slice(None)] * 2
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        out[tuple(before)] |= jump
        out[tuple(after)] |= jump
    return out


def points_of(view: RenderedDepth) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of a view with known depth as points.

    Returns:
        Points float64 [N, 3] (m) in the map frame, and their colours float32 [N, 3], RGB in [0, 1].
    """
    v, u = np.nonzero(np.isfinite(view.depth_m))
    z, c = view.depth_m[v, u].astype(np.float64), view.camera
    points = np.stack([(u - c.cx_px) / c.fx_px * z, (v - c.cy_px) / c.fy_px * z, z], axis=1)
    return points @ view.T_map_camera[:3, :3].T + view.T_map_camera[:3, 3], view.rgb[v, u]


def surface_points(views: Iterable[RenderedDepth], cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface points of all views, averaged in grid cells of edge `cell_m`.

    Returns:
        The mean point float64 [N, 3] (m, map frame) and the mean colour uint8 [N, 3] of each occupied cell.
    """
    cells, sums, waiting = np.zeros(0, np.int64), np.zeros((0, 7)), []
    for view in views:
        points, colours = points_of(view)
        rows = np.column_stack([points, colours, np.ones(len(points))])
        waiting.append(_summed(_cell_numbers(points, cell_m), rows))
        if sum(len(part[0]) for part in waiting) > _MAX_WAITING_ROWS:
            cells, sums = _joined([(cells, sums), *waiting])
            waiting = []
    cells, sums = _joined([(cells, sums), *waiting])
    means = sums[:, :6] / np.maximum(sums[:, 6:], 1.0)
    return means[:, :3], np.clip(means[:, 3:] * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)


def _cell_numbers(points: np.ndarray, cell_m: float) -> np.ndarray:
    """Return int64 [N], unique per cell within 2**20 cells of the origin."""
    x, y, z = (np.floor(points / cell_m).astype(np.int64) + (1 << 20)).T
    return (x << 42) | (y << 21) | z


def _joined(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    cells, rows = zip(*parts)
    return _summed(np.concatenate(cells), np.concatenate(rows))


def _summed(cells: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unique cells int64 [M], ascending, and the sums of their rows."""
    unique, which = np.unique(cells, return_inverse=True)
    sums = np.stack([np.bincount(which, column, len(unique)) for column in rows.T], axis=1)
    return unique, sums


def write_ply(path: Path, points: np.ndarray, colours: np.ndarray, faces: np.ndarray | None = None) -> None:
    """Write points [N, 3] with uint8 colours [N, 3], or a mesh with int32 faces [M, 3], as binary PLY."""
    vertex = np.zeros(len(points), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertex["xyz"], vertex["rgb"] = points, colours
    head = ["ply", "format binary_little_endian 1.0", "comment metres, z up", f"element vertex {len(points)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"property uchar {name}" for name in ("red", "green", "blue")]
    blob = vertex.tobytes()
    if faces is not None:
        face = np.zeros(len(faces), [("count", "u1"), ("index", "<i4", 3)])
        face["count"], face["index"] = 3, faces
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        blob += face.tobytes()
    write_atomically(Path(path), "\n".join([*head, "end_header", ""]).encode() + blob)
