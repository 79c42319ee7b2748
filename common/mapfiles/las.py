"""Coloured points as `.las` files: ASPRS LAS 1.2, point format 2, in the map frame (metres, z up).

Resolution: positions 0.1 mm within 214 km of the origin; colours exact (8 bits, stored in 16 bits).
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from beamsplat.common.files.persist import write_atomically

_SCALE_M = 1e-4  # of an integer coordinate
# Signature, source, encoding, GUID, version, system, software, day, year, header size, offset of the points,
# variable records, point format, point size, points, points by return, scale, offset, bounds.
_HEADER = struct.Struct("<4sHH16sBB32s32sHHHIIBHI5I3d3d6d")
_FORMAT = 2  # position and colour
_POINT = np.dtype([
    ("xyz", "<i4", 3), ("intensity", "<u2"), ("returns", "u1"), ("class", "u1"), ("angle", "i1"),
    ("user", "u1"), ("source", "<u2"), ("rgb", "<u2", 3),
])  # fmt: skip
_SINGLE_RETURN = 0b001_001  # number of returns, number of this return
_UNCLASSIFIED = 1
_TO_16_BITS = 257  # 255 becomes 65535, and a division by 256 or 257 gives the 8 bits back


def write_las(path: Path, points_map_m: np.ndarray, colours: np.ndarray) -> None:
    """Write points float64 [N, 3] with colours uint8 [N, 3], atomically.

    Raises:
        ValueError: there are no points, or a point is too far from the origin.
        OSError: the file cannot be written.
    """
    count = len(points_map_m)
    if count == 0:
        raise ValueError("there are no points to be written")
    fixed = np.round(points_map_m / _SCALE_M)
    if not np.abs(fixed).max() < 2**31:
        raise ValueError(f"a point is {np.abs(points_map_m).max():.0f} m from the origin, LAS allows 214748")
    records = np.zeros(count, _POINT)
    records["xyz"], records["rgb"] = fixed, colours.astype(np.uint16) * _TO_16_BITS
    records["returns"], records["class"] = _SINGLE_RETURN, _UNCLASSIFIED
    low, high = records["xyz"].min(axis=0) * _SCALE_M, records["xyz"].max(axis=0) * _SCALE_M
    bounds = np.stack([high, low], axis=1).ravel()  # largest x, smallest x, largest y, ...
    head = _HEADER.pack(
        b"LASF", 0, 0, bytes(16), 1, 2, b"BeamSplat", b"BeamSplat", 0, 0, _HEADER.size, _HEADER.size,
        0, _FORMAT, _POINT.itemsize, count, count, 0, 0, 0, 0, *[_SCALE_M] * 3, 0.0, 0.0, 0.0, *bounds,
    )  # fmt: skip
    write_atomically(Path(path), head + records.tobytes())
