"""Gaussians as 3DGS `.ply` files (INRIA layout), and reading the points of PLY files."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import make_folder
from beamsplat.common.geometry.trajectory import Trajectory, write_tum
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, PARAMS, QUAT, SCALE

SH_C0 = 0.28209479177387814  # value of the spherical harmonic of degree 0
_ROWS = 65_536  # Gaussians per write or read: bounds the memory
_MAX_HEADER_BYTES = 65_536  # ours has less than 1 kB
_END_OF_HEADER = b"end_header\n"
_PLY_TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "uchar": "u1", "uint8": "u1", "char": "i1",
              "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"}  # fmt: skip
FIELDS = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
          "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")  # fmt: skip
_NORMALS = ("nx", "ny", "nz")  # always zero; some files lack them


def write_gaussian_ply(path: Path, params: np.ndarray) -> None:
    """Write Gaussians float32 [14 + 3 K, N] in the INRIA 3DGS layout, atomically.

    The rows from 14 on are spherical harmonics, see `common.harmonics`.
    """
    write_gaussian_parts(path, params.shape[1], [params], params.shape[0] - PARAMS)


def write_gaussian_parts(path: Path, count: int, parts: Iterable[np.ndarray], harmonics: int = 0) -> None:
    """Write `count` Gaussians in the INRIA 3DGS layout, atomically.

    Args:
        parts: float32 [14 + harmonics, N] each.
        harmonics: number of rows of spherical harmonics: 0, 9, 24 or 45.

    Raises:
        ValueError: the parts have more or fewer Gaussians; then nothing is written.
    """
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    names = (*FIELDS[:9], *(f"f_rest_{k}" for k in range(harmonics)), *FIELDS[9:])
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    path, received = Path(path), 0
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        file.write("\n".join(header).encode())
        for params in parts:
            for first in range(0, params.shape[1], _ROWS):
                file.write(_rows(params[:, first : first + _ROWS]).tobytes())
            received += params.shape[1]
    if received != count:
        partial.unlink()
        raise ValueError(f"{path}: received {received} Gaussians, expected {count}")
    os.replace(partial, path)


def _rows(params: np.ndarray) -> np.ndarray:
    rest = params.shape[0] - PARAMS
    rows = np.zeros((params.shape[1], len(FIELDS) + rest), "<f4")
    rows[:, 0:3] = params[MEAN : MEAN + 3].T
    rows[:, 6:9] = (params[COLOUR : COLOUR + 3].T - 0.5) / SH_C0
    rows[:, 9 : 9 + rest] = params[PARAMS:].T
    shape = rows[:, 9 + rest :]
    shape[:, 0] = params[OPACITY]
    shape[:, 1:4] = params[SCALE : SCALE + 3].T
    quat = params[QUAT : QUAT + 4]
    shape[:, 4:8] = (quat / np.maximum(np.linalg.norm(quat, axis=0), 1e-12)).T
    return rows


def write_map(
    folder: Path,
    count: int,
    parts: Iterable[np.ndarray],  # float32 [14 + harmonics, N] each, `count` in all
    stamps_ns: np.ndarray,  # int64 [K], rising
    T_map_body: np.ndarray,  # float64 [K, 4, 4] of the keyframes
    harmonics: int = 0,  # rows of spherical harmonics in the parts
) -> None:
    """Create a folder with the Gaussians (`splats.ply`) and the keyframes' body poses (`keyframes.tum`).

    Raises:
        UserError: the folder cannot be created or written.
    """
    make_folder(folder)
    write_gaussian_parts(folder / "splats.ply", count, parts, harmonics)
    write_tum(folder / "keyframes.tum", Trajectory(stamps_ns, T_map_body), "keyframes of the map, refined")


def read_ply_points(path: Path) -> np.ndarray:
    """Return the vertices float64 [N, 3] of a binary little-endian PLY file with the vertices first.

    Raises:
        UserError: the file cannot be read, has another format, or is shorter than its header says.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head, found, _ = file.read(_MAX_HEADER_BYTES).partition(_END_OF_HEADER)
            fields, count = _vertex_fields(head.decode("ascii", "replace").split("\n"))
            if not found or not {"x", "y", "z"} <= {name for name, _ in fields}:
                raise ValueError("expected a binary little-endian PLY with x, y and z of its vertices")
            dtype, start = np.dtype(fields), len(head) + len(found)
            if count > (path.stat().st_size - start) // dtype.itemsize:
                raise ValueError(f"truncated: its header says {count} vertices")
            points = np.empty((count, 3))
            file.seek(start)
            for first in range(0, count, _ROWS):
                rows = np.frombuffer(file.read(min(_ROWS, count - first) * dtype.itemsize), dtype)
                points[first : first + len(rows)] = np.stack([rows[name] for name in "xyz"], axis=1)
            return points
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: {reason(error)}") from error


def read_gaussian_ply(path: Path) -> np.ndarray:
    """Return the Gaussians float32 [14, N] of a 3DGS `.ply` file (INRIA layout), in the file's frame.

    Colours are those of spherical harmonics of degree 0; coefficients of higher degrees are left out, and
    so are Gaussians with values that are not finite.

    Raises:
        UserError: the file cannot be read, has another format, lacks a property, or is shorter than its
            header says.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head, found, _ = file.read(_MAX_HEADER_BYTES).partition(_END_OF_HEADER)
            fields, count = _vertex_fields(head.decode("ascii", "replace").split("\n"))
            missing = [name for name in FIELDS if name not in _NORMALS and name not in dict(fields)]
            if not found or missing:
                raise ValueError(
                    f"no Gaussian splats: its vertices have no property {', '.join(missing[:3])}; expected "
                    "the layout of 3DGS, which `beamsplat export --to ply` and most trainers write"
                )
            dtype, start = np.dtype(fields), len(head) + len(found)
            if count > (path.stat().st_size - start) // dtype.itemsize:
                raise ValueError(f"truncated: its header says {count} Gaussians")
            out = np.empty((PARAMS, count), np.float32)
            file.seek(start)
            for first in range(0, count, _ROWS):
                rows = np.frombuffer(file.read(min(_ROWS, count - first) * dtype.itemsize), dtype)
                out[:, first : first + len(rows)] = _params(rows)
            return out[:, np.isfinite(out).all(axis=0)]
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: {reason(error)}") from error


def _params(rows: np.ndarray) -> np.ndarray:
    """Return the Gaussians float32 [14, M] in rows of a file; the inverse of `_rows`."""
    out = np.empty((PARAMS, len(rows)), np.float32)
    out[MEAN:SCALE] = [rows[name] for name in "xyz"]
    out[SCALE:QUAT] = [rows[f"scale_{i}"] for i in range(3)]
    quat = np.array([rows[f"rot_{i}"] for i in range(4)], np.float64)
    out[QUAT:OPACITY] = quat / np.maximum(np.linalg.norm(quat, axis=0), 1e-12)
    out[OPACITY] = rows["opacity"]
    out[COLOUR:] = [0.5 + SH_C0 * rows[f"f_dc_{i}"] for i in range(3)]
    return out


def _vertex_fields(lines: list[str]) -> tuple[list[tuple[str, str]], int]:
    """Return the (name, dtype) of the properties of the vertices in a header, and their number.

    Raises:
        ValueError: another format, a property that is a list or of unknown type, or a wrong number.
    """
    if "format binary_little_endian 1.0" not in lines:
        raise ValueError("expected a binary little-endian PLY")
    element, count = "", 0
    fields: list[tuple[str, str]] = []
    for words in map(str.split, lines):
        if words[:1] == ["element"]:
            if len(words) != 3 or not (words[2].isascii() and words[2].isdigit()) or len(words[2]) > 18:
                raise ValueError(f"wrong line in its header: {' '.join(words)!r}")
            element = words[1]
            if element == "vertex":
                count = int(words[2])
            elif not fields and int(words[2]):
                raise ValueError(f"its first elements are {element}, expected vertex")
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _PLY_TYPES:
                raise ValueError(f"property {' '.join(words[1:])!r} of vertices is not supported")
            fields.append((words[2], _PLY_TYPES[words[1]]))
    return fields, count
