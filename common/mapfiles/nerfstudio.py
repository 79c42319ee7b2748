"""The description of a data set for nerfstudio and programs that read its format (`transforms.json`).

World: the map frame, in metres, z up. Cameras: x right, y up, z back (OpenGL). Depth maps: millimetres.
https://docs.nerf.studio/quickstart/data_conventions.html
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.mapfiles.dataset import PIXEL_CENTRE, DatasetEntry, WrittenDataset
from beamsplat.common.mapfiles.surface import write_ply
from beamsplat.common.raster.camera import RasterCamera

_POINTS = "sparse_pc.ply"
_FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])  # T_camera_glcamera: y down, z forward <- y up, z back


def write_transforms(folder: Path, dataset: WrittenDataset) -> None:
    """Write `transforms.json` and `sparse_pc.ply` (the lidar points) beside the files of `write_frames`.

    Raises:
        OSError: a file cannot be written.
    """
    cameras = {entry.camera for entry in dataset.entries}
    shared = _intrinsics(dataset.entries[0].camera) if len(cameras) == 1 else {}
    # Without a distortion model of its own: OPENCV with zeros is the pinhole that all readers know.
    table: dict[str, Any] = {"camera_model": "OPENCV", **shared, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    table["orientation_override"] = "none"  # z is up already, by the lidar and the robot's mount
    if len(dataset.points.points_map_m):
        write_ply(folder / _POINTS, dataset.points.points_map_m, dataset.points.colours)
        table["ply_file_path"] = _POINTS
    table["frames"] = [
        _frame(entry, {} if shared else _intrinsics(entry.camera), dataset.masked)
        for entry in dataset.entries
    ]
    write_atomically(folder / "transforms.json", json.dumps(table, indent=1).encode())


def _intrinsics(camera: RasterCamera) -> dict[str, Any]:
    return {
        "fl_x": camera.fx_px, "fl_y": camera.fy_px,
        "cx": camera.cx_px + PIXEL_CENTRE, "cy": camera.cy_px + PIXEL_CENTRE,
        "w": camera.width_px, "h": camera.height_px,
    }  # fmt: skip


def _frame(entry: DatasetEntry, intrinsics: dict[str, Any], masked: bool) -> dict[str, Any]:
    out = {"file_path": entry.image, "depth_file_path": entry.depth, **intrinsics}
    if masked:
        out["mask_path"] = entry.mask
    # Not part of the format, and ignored by its readers: to find the keyframe of an image again.
    out |= {"keyframe_id": entry.id, "stamp_ns": entry.stamp_ns}
    return out | {"transform_matrix": (entry.T_map_camera @ _FLIP_YZ).tolist()}
