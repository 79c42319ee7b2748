"""Gaussians as `.sog` files (PlayCanvas), version 2: a ZIP of lossless WebP images, y down.

Resolution: positions 16 bits of the logarithm, (1 + |x|) * range / 131070 with range = the difference of the
logarithms sign(x) ln(1 + |x|) at both ends: 0.6 mm at 10 m, 1.6 mm at 30 m from the origin of a map of
60 m; log scales 1/255 of their range; colours 1/255; opacity 1/255; rotations 1.1 degrees.
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.geometry.transforms import make_transform
from beamsplat.common.mapfiles.morton import morton_order
from beamsplat.common.mapfiles.ply import SH_C0
from beamsplat.common.mapfiles.store import transform_gaussians
from beamsplat.common.mapfiles.y_up import R_ydown_map
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, QUAT, SCALE

_LOSSLESS = (cv2.IMWRITE_WEBP_QUALITY, 101)  # OpenCV: above 100 is lossless
_MAX_LOG_SCALE = 20.0
_COLOURS = (-0.5, 1.5)  # colours outside are clipped; half a step of this range is 1/255
_LARGEST_W = 252  # alpha of a rotation whose w is the largest component; x, y, z follow
_FIRST_DAY = (1980, 1, 1, 0, 0, 0)  # of ZIP: the same bytes in every run


def write_sog(path: Path, params: np.ndarray) -> None:
    """Write Gaussians float32 [14, N], in the map frame, atomically.

    Raises:
        ValueError: there are no Gaussians.
        OSError: the file cannot be written.
    """
    count = params.shape[1]
    if count == 0:
        raise ValueError("the map has no Gaussians: a SOG file cannot be empty")
    params = transform_gaussians(params, make_transform(R_ydown_map, np.zeros(3)))
    rows = params[:, morton_order(params[MEAN:SCALE].T)].T.astype(np.float64)
    low, high, words = _positions(rows[:, MEAN:SCALE])
    scales, scale_codebook = _indices(np.clip(rows[:, SCALE:QUAT], -_MAX_LOG_SCALE, _MAX_LOG_SCALE))
    colours, colour_codebook = _indices(np.clip(rows[:, COLOUR : COLOUR + 3], *_COLOURS))
    # Transparent pixels would lose their colour: WebP does not store it.
    opacity = np.clip(np.round(255.0 / (1.0 + np.exp(-rows[:, OPACITY]))), 1.0, 255.0)
    images = {
        "means_l.webp": words & 255, "means_u.webp": words >> 8, "scales.webp": scales,
        "quats.webp": _rotations(rows[:, QUAT:OPACITY]), "sh0.webp": np.column_stack([colours, opacity]),
    }  # fmt: skip
    meta: dict[str, Any] = {
        "version": 2, "asset": {"generator": "BeamSplat"}, "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_codebook.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": ((colour_codebook - 0.5) / SH_C0).tolist(), "files": ["sh0.webp"]},
    }  # fmt: skip
    files = {"meta.json": json.dumps(meta, separators=(",", ":")).encode()}
    files |= {name: _webp(values.astype(np.uint8)) for name, values in images.items()}
    write_atomically(Path(path), _zip(files))


def _positions(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the bounds [3], [3] of the logarithms of points [N, 3], and their 16 bits, int64 [N, 3]."""
    logs = np.sign(points) * np.log1p(np.abs(points))
    low, high = logs.min(axis=0), logs.max(axis=0)
    return low, high, np.round((logs - low) / np.maximum(high - low, 1e-9) * 65535.0).astype(np.int64)


def _indices(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest entries of an even codebook, int64 [N, 3], and the codebook float64 [256]."""
    low, high = float(values.min()), float(values.max())
    step = max(high - low, 1e-9) / 255.0
    return np.round((values - low) / step).astype(np.int64), low + step * np.arange(256.0)


def _rotations(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return quaternions [N, 4] as pixels: 8 bits of each component but the largest, and which that is."""
    quat = quat_wxyz / np.maximum(np.linalg.norm(quat_wxyz, axis=1, keepdims=True), 1e-12)
    largest = np.argmax(np.abs(quat), axis=1)[:, None]
    quat = quat * np.where(np.take_along_axis(quat, largest, axis=1) < 0.0, -1.0, 1.0)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest[:, 0]]
    small = np.take_along_axis(quat, others, axis=1) * 2.0**0.5
    return np.column_stack([np.clip(np.round((small + 1.0) * 127.5), 0, 255), _LARGEST_W + largest])


def _webp(pixels: np.ndarray) -> bytes:
    """Return uint8 [N, 3 or 4] (RGB, RGBA) as an image of about square shape, by rows."""
    count, channels = pixels.shape
    width = 4 * math.ceil(math.sqrt(count) / 4)
    height = 4 * math.ceil(count / width / 4)
    image = np.zeros((height * width, channels), np.uint8)
    image[:count] = pixels
    image = image.reshape(height, width, channels)
    image[..., :3] = image[..., 2::-1].copy()  # OpenCV expects BGR
    return cv2.imencode(".webp", image, _LOSSLESS)[1].tobytes()


def _zip(files: dict[str, bytes]) -> bytes:
    """Return files as a ZIP; WebP does not become smaller by compression."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, _FIRST_DAY), data)
    return buffer.getvalue()
