"""Keyframes as a data set for programs that train or reconstruct from images with known poses.

The folder has `images/` (undistorted), `depths/` (PNG of uint16 millimetres of optical z, 0 = unknown) and,
if there are pixels to be ignored, `masks/` (PNG, 0 = ignore). `nerfstudio.py` and `colmap.py` add the files
that describe them. Those programs put the centre of the first pixel at (0.5, 0.5), we at (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.messages.depth_codec import depth_to_mm
from beamsplat.common.messages.depth_png import depth_to_png, mask_to_png
from beamsplat.common.raster.camera import RasterCamera

PIXEL_CENTRE = 0.5  # added to our pixel coordinates, cx and cy: see above


@dataclass(frozen=True)
class DatasetFrame:
    """One keyframe: its undistorted image with everything that is known about it."""

    id: int
    stamp_ns: int
    camera: RasterCamera
    T_map_camera: np.ndarray
    rgb: np.ndarray  # uint8 [H, W, 3]
    encoded: tuple[str, bytes] | None  # ("jpeg" or "png", file) if the undistorted image exists as a file
    depth_m: np.ndarray  # float32 [H, W] optical z, NaN = unknown
    mask: np.ndarray  # bool [H, W], False = not to be used: a dynamic object, or outside the original
    beams_uvz_sigma: np.ndarray  # float64 [N, 4], lidar returns: px, px, optical z in m, sigma in m


@dataclass(frozen=True)
class DatasetEntry:
    """A frame whose files have been written. Paths are relative to the folder of the data set."""

    id: int
    stamp_ns: int
    camera: RasterCamera
    T_map_camera: np.ndarray
    image: str
    depth: str
    mask: str


@dataclass(frozen=True)
class LidarPoints:
    """Lidar returns as coloured points, each seen by the image of its keyframe."""

    points_map_m: np.ndarray  # float64 [N, 3]
    colours: np.ndarray  # uint8 [N, 3], RGB
    entry: np.ndarray  # int64 [N], index of the frame
    uv_px: np.ndarray  # float64 [N, 2], pixel in this frame
    sigma_m: np.ndarray  # float64 [N], standard deviation of the distance


@dataclass(frozen=True)
class WrittenDataset:
    """What `write_frames` has written."""

    entries: list[DatasetEntry]
    points: LidarPoints
    masked: bool  # whether `masks/` exists; it then has a file for each frame


def write_frames(folder: Path, frames: Iterable[DatasetFrame], cell_m: float) -> WrittenDataset:
    """Write images, depth maps and masks, and return them with the lidar points that the frames see.

    Args:
        folder: must exist; its files are not written atomically.
        cell_m: of all returns in a grid cell of this edge, the one with the smallest standard deviation is
            kept; 0 keeps all of them.

    Raises:
        OSError: a file cannot be written.
    """
    for name in ("images", "depths"):
        (folder / name).mkdir(exist_ok=True)
    entries: list[DatasetEntry] = []
    parts: list[LidarPoints] = []
    masked: set[int] = set()
    for frame in frames:
        kind, data = frame.encoded or ("png", _png(frame.rgb))
        name = f"frame_{len(entries) + 1:06d}.{'jpg' if kind == 'jpeg' else 'png'}"
        entry = DatasetEntry(
            frame.id, frame.stamp_ns, frame.camera, frame.T_map_camera,
            f"images/{name}", f"depths/{Path(name).stem}.png", f"masks/{name}.png",
        )  # fmt: skip
        (folder / entry.image).write_bytes(data)
        (folder / entry.depth).write_bytes(depth_to_png(depth_to_mm(frame.depth_m)).tobytes())
        if not frame.mask.all():
            masked.add(len(entries))
            _write_mask(folder / entry.mask, frame.mask)
        parts.append(_points_of(frame, len(entries)))
        entries.append(entry)
    if masked:  # readers expect a mask for each frame or for none
        for number, entry in enumerate(entries):
            if number not in masked:
                shape = entry.camera.height_px, entry.camera.width_px
                _write_mask(folder / entry.mask, np.ones(shape, bool))
    return WrittenDataset(entries, _thinned(parts, cell_m), bool(masked))


def _png(rgb: np.ndarray) -> bytes:
    return cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()


def _write_mask(path: Path, mask: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(mask_to_png(mask).tobytes())


def _points_of(frame: DatasetFrame, entry: int) -> LidarPoints:
    """Return the lidar returns of a frame that hit pixels to be used, as points in the map frame."""
    c = frame.camera
    u, v, z, sigma = frame.beams_uvz_sigma.T
    column, row = np.round(u).astype(int), np.round(v).astype(int)
    use = (z > 0.0) & (column >= 0) & (row >= 0) & (column < c.width_px) & (row < c.height_px)
    use[use] = frame.mask[row[use], column[use]]
    u, v, z = u[use], v[use], z[use]
    camera = np.stack([(u - c.cx_px) / c.fx_px * z, (v - c.cy_px) / c.fy_px * z, z], axis=1)
    points = camera @ frame.T_map_camera[:3, :3].T + frame.T_map_camera[:3, 3]
    colours = frame.rgb[row[use], column[use]]
    return LidarPoints(
        points, colours, np.full(len(points), entry), np.stack([u, v], axis=1), sigma[use]
    )  # fmt: skip


def _thinned(parts: list[LidarPoints], cell_m: float) -> LidarPoints:
    """Join points, ordered by frame, and keep the most exact one of each grid cell."""
    names = tuple(LidarPoints.__annotations__)
    none = LidarPoints(
        np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0)
    )
    parts = [none, *parts]
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    points = columns["points_map_m"]
    if cell_m > 0.0 and len(points):
        order = np.argsort(columns["sigma_m"], kind="stable")
        cells = np.floor(points[order] / cell_m).astype(np.int64)
        kept = np.sort(order[np.unique(cells, axis=0, return_index=True)[1]])
        columns = {name: column[kept] for name, column in columns.items()}
    return LidarPoints(**columns)
