"""The description of a data set as a COLMAP model, binary or text.

World: the map frame, in metres, z up. Cameras: x right, y down, z forward, as ours. Each point is a lidar
return, observed in one image at the pixel that the beam projects to, so its reprojection error is zero.
https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.geometry.transforms import inverse, quat_wxyz_from_matrix
from beamsplat.common.mapfiles.dataset import PIXEL_CENTRE, WrittenDataset
from beamsplat.common.raster.camera import RasterCamera

_PINHOLE = 1  # id of the camera model with the parameters fx, fy, cx, cy


@dataclass(frozen=True)
class _ColmapImage:
    camera: int
    pose: list[float]  # of T_camera_map: quaternion wxyz, translation in m
    name: str
    uv_px: np.ndarray  # float64 [M, 2], in COLMAP's pixels
    points: np.ndarray  # int64 [M], ids of the points


@dataclass(frozen=True)
class _ColmapModel:
    """The tables of a model. All ids are positions in the lists plus 1."""

    cameras: Sequence[RasterCamera]
    images: Sequence[_ColmapImage]
    positions: np.ndarray  # float64 [N, 3]
    colours: np.ndarray  # uint8 [N, 3]
    track: np.ndarray  # int64 [N, 2]: id of the image, index of the pixel in its list


def write_model(folder: Path, dataset: WrittenDataset, text: bool) -> None:
    """Write cameras, images and points3D, as `.txt` if `text`, else as `.bin`, into `folder`.

    Raises:
        OSError: a file cannot be written.
    """
    model = _model_of(dataset)
    files = _text(model) if text else _binary(model)
    for name, data in files.items():
        write_atomically(folder / f"{name}.{'txt' if text else 'bin'}", data)


def _model_of(dataset: WrittenDataset) -> _ColmapModel:
    points = dataset.points
    cameras = list(dict.fromkeys(entry.camera for entry in dataset.entries))
    images, index = [], np.zeros(len(points.entry), np.int64)
    for number, entry in enumerate(dataset.entries):
        mine = np.flatnonzero(points.entry == number)
        index[mine] = np.arange(len(mine))
        T = inverse(entry.T_map_camera)
        pose = [*quat_wxyz_from_matrix(T[:3, :3]).tolist(), *T[:3, 3].tolist()]
        name, camera = PurePosixPath(entry.image).name, cameras.index(entry.camera) + 1
        images.append(_ColmapImage(camera, pose, name, points.uv_px[mine] + PIXEL_CENTRE, mine + 1))
    track = np.stack([points.entry + 1, index], axis=1)
    return _ColmapModel(cameras, images, points.points_map_m, points.colours, track)


def _parameters(camera: RasterCamera) -> tuple[float, float, float, float]:
    return camera.fx_px, camera.fy_px, camera.cx_px + PIXEL_CENTRE, camera.cy_px + PIXEL_CENTRE


def _binary(model: _ColmapModel) -> dict[str, bytes]:
    cameras = [struct.pack("<Q", len(model.cameras))]
    for id, camera in enumerate(model.cameras, 1):
        size = camera.width_px, camera.height_px
        cameras.append(struct.pack("<IiQQ4d", id, _PINHOLE, *size, *_parameters(camera)))
    images = [struct.pack("<Q", len(model.images))]
    for id, image in enumerate(model.images, 1):
        head = struct.pack("<I7dI", id, *image.pose, image.camera)
        observed = np.empty(len(image.points), [("uv", "<f8", 2), ("point", "<u8")])
        observed["uv"], observed["point"] = image.uv_px, image.points
        count = struct.pack("<Q", len(observed))
        images += [head, image.name.encode(), b"\0", count, observed.tobytes()]
    points = np.empty(
        len(model.positions),
        [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8"),
         ("track", "<u4", 2)],
    )  # fmt: skip
    points["id"], points["xyz"] = np.arange(1, len(points) + 1), model.positions
    points["rgb"], points["error"], points["length"], points["track"] = model.colours, 0.0, 1, model.track
    return {
        "cameras": b"".join(cameras), "images": b"".join(images),
        "points3D": struct.pack("<Q", len(points)) + points.tobytes(),
    }  # fmt: skip


def _text(model: _ColmapModel) -> dict[str, bytes]:
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for id, camera in enumerate(model.cameras, 1):
        cameras.append(f"{id} PINHOLE {camera.width_px} {camera.height_px} {_words(_parameters(camera))}")
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for id, image in enumerate(model.images, 1):
        images.append(f"{id} {_words(image.pose)} {image.camera} {image.name}")
        pairs = zip(image.uv_px.tolist(), image.points.tolist())
        images.append(" ".join(f"{u!r} {v!r} {point}" for (u, v), point in pairs))
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    rows = zip(model.positions.tolist(), model.colours.tolist(), model.track.tolist())
    for id, (position, colour, track) in enumerate(rows, 1):
        points.append(f"{id} {_words(position)} {_words(colour)} 0.0 {_words(track)}")
    tables = {"cameras": cameras, "images": images, "points3D": points}
    return {name: ("\n".join(lines) + "\n").encode() for name, lines in tables.items()}


def _words(values: Sequence[float]) -> str:
    return " ".join(repr(value) for value in values)
