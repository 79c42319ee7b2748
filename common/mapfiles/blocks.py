"""Files with blocks of Gaussians, stored beside the state of a session.

A block file is written once and never changed. A checkpoint lists the blocks that belong to it; a file is
removed only after a later checkpoint that does not list it.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.harmonics.basis import degree_of, rotated, with_degree
from beamsplat.common.mapfiles.store import HARMONIC_ARRAYS, transform_with_momentum

_MAGIC = b"BSGB"
_HEAD = struct.Struct("<4sII")  # magic, CRC-32 of all bytes after the header, length of the table of arrays

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Block:
    """The description of a block of Gaussians, stored in the checkpoint: known without reading its file."""

    number: int  # of the file
    anchor: int
    count: int  # of Gaussians
    steps: int  # of the optimiser, summed over the Gaussians
    centre_anchor_m: np.ndarray  # [3], in the anchor's frame
    radius_m: float  # of the sphere around the centre that contains all rendered extents
    T_map_anchor: np.ndarray  # at the time of writing


def block_file(folder: Path, number: int) -> Path:
    return folder / f"{number}.block"


def arrays_of_blocks(blocks: list[Block]) -> Arrays:
    """Return the checkpoint arrays `block_<field>` that describe `blocks`; {} if there are no blocks."""
    if not blocks:
        return {}
    return {f"block_{name}": np.array([getattr(b, name) for b in blocks]) for name in Block.__annotations__}


def blocks_of(arrays: Arrays) -> list[Block]:
    """Return the descriptions of the blocks that a checkpoint lists (inverse of `arrays_of_blocks`).

    Raises:
        KeyError: an array is missing.
    """
    if "block_number" not in arrays:
        return []
    columns = [arrays[f"block_{name}"] for name in Block.__annotations__]
    return [
        Block(int(n), int(a), int(c), int(s), centre, float(r), T)
        for n, a, c, s, centre, r, T in zip(*columns)
    ]


def write_block(folder: Path, number: int, arrays: Arrays) -> None:
    """Write the arrays of N Gaussians to a block file, with a checksum; the caller must call `sync` later.

    The arrays are [..., N] with 4 bytes per element (float32, int32).

    Raises:
        OSError: the disk is full or broken.
    """
    rows = [
        np.ascontiguousarray(array).view(np.uint32).reshape(-1, array.shape[-1]) for array in arrays.values()
    ]
    body = np.concatenate(rows).tobytes()
    table = {name: [array.dtype.str, array.ndim, len(r)] for (name, array), r in zip(arrays.items(), rows)}
    table_bytes = json.dumps({"count": rows[0].shape[1], "arrays": table}).encode()
    head = _HEAD.pack(_MAGIC, zlib.crc32(body, zlib.crc32(table_bytes)), len(table_bytes))
    with block_file(folder, number).open("xb") as file:
        file.write(head + table_bytes)
        file.write(body)


def read_block(folder: Path, block: Block, T_map_anchor: np.ndarray) -> Arrays:
    """Return the arrays of a block, transformed to the current pose of its anchor.

    The arrays are bit-identical to the written arrays if the anchor has not moved.

    Raises:
        UserError: the file is missing or altered.
    """
    path = block_file(folder, block.number)
    try:
        arrays = _unpacked(path.read_bytes())
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); restore it from a copy") from error
    except ValueError as error:
        raise UserError(f"{path}: {error}; restore it from a copy") from error
    return placed(arrays, block, T_map_anchor)


def placed(arrays: Arrays, block: Block, T_map_anchor: np.ndarray) -> Arrays:
    """Return the arrays of a block as they were written, transformed to the current pose of its anchor."""
    if np.array_equal(T_map_anchor, block.T_map_anchor):
        return arrays
    move = T_map_anchor @ inverse(block.T_map_anchor)
    params, first = transform_with_momentum(arrays["params"], arrays["first"], move)
    turned = {name: rotated(arrays[name], move[:3, :3]) for name in HARMONIC_ARRAYS[:2] if name in arrays}
    return arrays | {"params": params, "first": first} | turned


def _unpacked(blob: bytes) -> Arrays:
    if len(blob) < _HEAD.size:
        raise ValueError("truncated")
    magic, checksum, length = _HEAD.unpack_from(blob)
    if magic != _MAGIC or zlib.crc32(blob[_HEAD.size :]) != checksum:
        raise ValueError("truncated or altered")
    head = json.loads(blob[_HEAD.size : _HEAD.size + length])
    rows = np.frombuffer(blob, np.uint32, offset=_HEAD.size + length).reshape(-1, head["count"])
    out, at = {}, 0
    for name, (dtype, dimensions, number) in head["arrays"].items():
        part = rows[at : at + number].view(dtype)
        out[name], at = part if dimensions == 2 else part[0], at + number
    return out


def with_blocks(folder: Path, arrays: Arrays) -> Arrays:
    """Return a checkpoint with all Gaussians in its `store_*` arrays; blocks are read and merged into them.

    Raises:
        UserError: a block cannot be read.
    """
    blocks = blocks_of(arrays)
    if not blocks:
        return arrays
    T_map_anchor = dict(zip(arrays["anchor_id"].tolist(), arrays["anchor_T_map"]))
    read = [read_block(folder, block, T_map_anchor[block.anchor]) for block in blocks]
    for block, part in zip(blocks, read):
        part["anchor"] = np.full(block.count, block.anchor, np.int64)
    out = {key: array for key, array in arrays.items() if not key.startswith("block_")}
    names = {key.removeprefix("store_") for key in out if key.startswith("store_")} - {"events"}
    for name in names:
        own = arrays[f"store_{name}"]
        out[f"store_{name}"] = np.concatenate([own, *(_part(r, name, own) for r in read)], axis=-1)
    return out


def _part(block: Arrays, name: str, own: np.ndarray) -> np.ndarray:
    """Return an array of a block; harmonics, which it may lack, with as many rows as those in `own`."""
    if name not in HARMONIC_ARRAYS:
        return block[name]
    none = np.zeros((0, block["params"].shape[1]), np.float32)
    return with_degree(block.get(name, none), degree_of(len(own)))


def sync(folder: Path, numbers: Iterable[int]) -> None:
    """Flush block files, and their folder, to the disk (fsync).

    Raises:
        OSError: the disk is full or broken.
    """
    paths: list[Path] = [block_file(folder, number) for number in numbers]
    for path in [*paths, *([folder] if paths else [])]:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
