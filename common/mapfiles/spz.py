"""Gaussians as `.spz` files (Niantic), version 3: 20 bytes each before gzip, y up.

Resolution: positions 1/4096 m within 2 km of the origin, scales 6 %, colours and opacity 1/255.
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.geometry.transforms import make_transform
from beamsplat.common.mapfiles.ply import SH_C0
from beamsplat.common.mapfiles.store import transform_gaussians
from beamsplat.common.mapfiles.y_up import R_yup_map
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, QUAT, SCALE

_HEAD = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, fraction bits, flags, reserved
_FRACTION_BITS = 12
_COLOUR_SCALE = 0.15  # of the harmonic of degree 0 (format): leaves room for colours outside 0..1


def write_spz(path: Path, params: np.ndarray) -> None:
    """Write Gaussians float32 [14, N], in the map frame, atomically.

    Raises:
        ValueError: a Gaussian is more than 2047 m from the origin.
        OSError: the file cannot be written.
    """
    params = transform_gaussians(params, make_transform(R_yup_map, np.zeros(3)))
    fixed = np.round(params[MEAN : MEAN + 3].T.astype(np.float64) * (1 << _FRACTION_BITS))
    if fixed.size and np.abs(fixed).max() >= 1 << 23:
        raise ValueError(
            f"a Gaussian is {np.abs(params[:3]).max():.0f} m from the origin, SPZ allows 2047; use ply"
        )
    words = np.ascontiguousarray(fixed.astype("<i4"))
    positions = words.view("u1").reshape(*words.shape, 4)[..., :3]  # little endian: the low 24 bits
    opacity = 1.0 / (1.0 + np.exp(-params[OPACITY].astype(np.float64)))
    harmonic = (params[COLOUR : COLOUR + 3].T.astype(np.float64) - 0.5) / SH_C0
    columns = [
        positions, _byte(opacity * 255.0), _byte(harmonic * (_COLOUR_SCALE * 255.0) + 127.5),
        _byte((params[SCALE : SCALE + 3].T.astype(np.float64) + 10.0) * 16.0), _smallest_three(params),
    ]  # fmt: skip
    head = _HEAD.pack(b"NGSP", 3, params.shape[1], 0, _FRACTION_BITS, 0, 0)
    body = b"".join(np.ascontiguousarray(column).tobytes() for column in columns)
    write_atomically(Path(path), gzip.compress(head + body, 6, mtime=0))


def _byte(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0.0, 255.0).astype("u1")


def _smallest_three(params: np.ndarray) -> np.ndarray:
    """Return the quaternions packed as uint32 [N]: index of the largest of x, y, z, w; sign and 9 bits of the
    others.
    """
    w, x, y, z = params[QUAT : QUAT + 4].astype(np.float64)
    quat = np.stack([x, y, z, w], axis=1)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    largest = np.argmax(np.abs(quat), axis=1)
    rows = np.arange(len(quat))
    quat *= np.where(quat[rows, largest] < 0.0, -1.0, 1.0)[:, None]
    out = largest.astype(np.uint32)
    for i in range(4):
        magnitude = np.minimum(np.floor(511.0 * np.abs(quat[:, i]) * 2.0**0.5 + 0.5), 511.0).astype(np.uint32)
        packed = (out << 10) | ((quat[:, i] < 0.0).astype(np.uint32) << 9) | magnitude
        out = np.where(largest == i, out, packed).astype(np.uint32)
    return out.astype("<u4")
