"""Gaussians as compressed `.ply` files (PlayCanvas, SuperSplat): 16 bytes each, y down.

Chunks of 256 neighbours share their bounds. Resolution: x and z 1/2047, y 1/1023 of the chunk's extent; log
scales likewise; colours 1/255 of the chunk's range; opacity 1/255; rotations 0.3 degrees.
https://blog.playcanvas.com/compressing-gaussian-splats
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.geometry.transforms import make_transform
from beamsplat.common.mapfiles.morton import morton_order
from beamsplat.common.mapfiles.store import transform_gaussians
from beamsplat.common.mapfiles.y_up import R_ydown_map
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, QUAT, SCALE

_CHUNK = 256  # Gaussians
_BOUNDS = [
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
]
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_VECTOR_BITS, _COLOUR_BITS = (11, 10, 11), (8, 8, 8)
_MAX_LOG_SCALE = 20.0  # readers clamp to it


def write_compressed_ply(path: Path, params: np.ndarray) -> None:
    """Write Gaussians float32 [14, N], in the map frame, atomically.

    Raises:
        ValueError: there are no Gaussians.
        OSError: the file cannot be written.
    """
    count = params.shape[1]
    if count == 0:
        raise ValueError("the map has no Gaussians: a compressed PLY cannot be empty")
    params = transform_gaussians(params, make_transform(R_ydown_map, np.zeros(3)))
    order = morton_order(params[MEAN:SCALE].T)
    order = np.append(order, np.repeat(order[-1:], -count % _CHUNK))  # the last chunk is filled up
    rows = params[:, order].T.astype(np.float64).reshape(-1, _CHUNK, params.shape[0])
    bounds, packed = [], []
    for first, bits in ((MEAN, _VECTOR_BITS), (SCALE, _VECTOR_BITS), (COLOUR, _COLOUR_BITS)):
        values = rows[..., first : first + 3]
        if first == SCALE:
            values = np.clip(values, -_MAX_LOG_SCALE, _MAX_LOG_SCALE)
        # The bounds of the file: float32.
        low, high = (f(values, axis=1).astype(np.float32).astype(np.float64) for f in (np.min, np.max))
        bounds += [low, high]
        packed.append(_fixed((values - low[:, None]) / np.maximum(high - low, 1e-9)[:, None], bits))
    # 0 and 1 would become infinite logits.
    opacity = np.clip(np.round(255.0 / (1.0 + np.exp(-rows[..., OPACITY]))), 1.0, 254.0).astype(np.uint32)
    words = [packed[0], _rotations(rows[..., QUAT : QUAT + 4]), packed[1], packed[2] << 8 | opacity]
    vertices = np.stack([word.reshape(-1)[:count] for word in words], axis=1).astype("<u4")
    chunks = np.concatenate(bounds, axis=1).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element chunk {len(chunks)}"]
    header += [f"property float {name}" for name in _BOUNDS] + [f"element vertex {count}"]
    header += [f"property uint {name}" for name in _PACKED] + ["end_header", ""]
    write_atomically(Path(path), "\n".join(header).encode() + chunks.tobytes() + vertices.tobytes())


def _fixed(unit: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Pack float [..., 3] in [0, 1] into uint32 [...], the first number in the highest bits."""
    out = np.zeros(unit.shape[:-1], np.uint32)
    for axis, width in enumerate(bits):
        largest = (1 << width) - 1
        number = np.clip(np.round(unit[..., axis] * largest), 0, largest).astype(np.uint32)
        out = out << np.uint32(width) | number
    return out


def _rotations(quat_wxyz: np.ndarray) -> np.ndarray:
    """Pack quaternions [..., 4] of any norm: index of the largest of w, x, y, z; the others in 10 bits."""
    quat = quat_wxyz / np.maximum(np.linalg.norm(quat_wxyz, axis=-1, keepdims=True), 1e-12)
    largest = np.argmax(np.abs(quat), axis=-1)[..., None]
    quat = quat * np.where(np.take_along_axis(quat, largest, axis=-1) < 0.0, -1.0, 1.0)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest[..., 0]]
    small = np.take_along_axis(quat, others, axis=-1) * 0.5**0.5 + 0.5
    return largest[..., 0].astype(np.uint32) << np.uint32(30) | _fixed(small, (10, 10, 10))
