"""Lossless encoding of depth maps, their standard deviations and masks in messages.

    "BSZ1" | uint8 bytes per value | uint8 0 | uint16 height | uint16 width | zstd frame

Depth is uint16 millimetres: a quantisation error of at most 0.5 mm. Standard deviations are uint8 codes on a
logarithmic scale, see `sigma_to_codes`. Both are quantised once, by fusion; all later stages pass on the same
bytes. Values are stored as the difference to the pixel above, which is small on walls and smooth on the
floor, as unsigned numbers (0, -1, 1, -2, ...), low bytes before high bytes.

Messages of earlier versions contain PNG files (`depth_png`) in the same fields; the decoders read both.
"""

from __future__ import annotations

import struct

import numpy as np
import zstandard

from beamsplat.common.messages import depth_png
from beamsplat.common.messages.sensor_models import MAX_PIXELS

MAX_DEPTH_M = 65.0  # larger depths are unknown
_HEAD = struct.Struct("<4sBxHH")
_MAGIC = b"BSZ1"
_PNG = b"\x89PNG"
_LEVEL = 1  # of zstd: higher levels take several times longer for some percent
_SIGMA_M = 1e-3  # sigma of code 1
_PER_OCTAVE = 16  # codes per doubling of sigma: the quantisation error is at most 2.2 %
_SIGMAS_M = (_SIGMA_M * np.exp2((np.arange(256) - 1.0) / _PER_OCTAVE)).astype(np.float32)
_SIGMAS_M[0] = np.nan


def pack_depth(depth_m: np.ndarray) -> np.ndarray:
    """Encode depth float32 [H, W] (m) as bytes uint8 [B]; NaN and values outside (0, 65) m are unknown.

    Raises:
        ValueError: not two dimensions of 1 to 16384 pixels each.
    """
    return _pack(depth_to_mm(depth_m))


def unpack_depth(packed: np.ndarray, shape: tuple[int, int] | None = None) -> np.ndarray:
    """Decode the bytes uint8 [B] of `pack_depth`, or of a PNG, to float32 [H, W] (m); NaN = unknown.

    Args:
        shape: expected (H, W); None = any. A PNG needs a shape.

    Raises:
        ValueError: the bytes are truncated or damaged, or the depth has another shape.
    """
    return mm_to_depth(unpack_depth_mm(packed, shape))


def unpack_depth_mm(packed: np.ndarray, shape: tuple[int, int] | None = None) -> np.ndarray:
    """Decode as `unpack_depth`, to uint16 [H, W] (mm); 0 = unknown."""
    if shape is not None and _is_png(packed):
        return depth_png.depth_mm_from_png(packed, shape)
    return _unpack(packed, shape, np.dtype(np.uint16), "depth")


def pack_sigma(sigma_m: np.ndarray) -> np.ndarray:
    """Encode standard deviations float32 [H, W] (m) as bytes uint8 [B]; NaN = unknown.

    Raises:
        ValueError: not two dimensions of 1 to 16384 pixels each.
    """
    return _pack(sigma_to_codes(sigma_m))


def unpack_sigma(packed: np.ndarray, shape: tuple[int, int] | None = None) -> np.ndarray:
    """Decode the bytes of `pack_sigma`, or of a PNG, to float32 [H, W] (m); see `unpack_depth`."""
    if shape is not None and _is_png(packed):
        return _SIGMAS_M[depth_png.sigma_codes_from_png(packed, shape)]
    return _SIGMAS_M[_unpack(packed, shape, np.dtype(np.uint8), "sigma")]


def pack_mask(mask: np.ndarray) -> np.ndarray:
    """Encode a mask bool [H, W] as bytes uint8 [B]."""
    return _pack(mask.astype(np.uint8))


def unpack_mask(packed: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Decode the bytes of `pack_mask`, or of a PNG, to bool [H, W]; see `unpack_depth`."""
    if _is_png(packed):
        return depth_png.mask_from_png(packed, shape)
    return _unpack(packed, shape, np.dtype(np.uint8), "mask") > 0


def packed_shape(packed: np.ndarray) -> tuple[int, int]:
    """Return (H, W) of packed depth, sigma or mask from its first bytes; the pixels are not decoded.

    Raises:
        ValueError: the bytes do not start as those of `pack_depth`.
    """
    return _head(packed, "depth")[1:]


def depth_to_mm(depth_m: np.ndarray) -> np.ndarray:
    """Return depth (m) in uint16 millimetres, rounded; 0 = unknown: NaN and values outside (0, 65) m."""
    with np.errstate(invalid="ignore"):
        fits = (depth_m > 0.0) & (depth_m < MAX_DEPTH_M)
    return np.where(fits, depth_m * np.float32(1e3) + np.float32(0.5), np.float32(0.0)).astype(np.uint16)


def mm_to_depth(depth_mm: np.ndarray) -> np.ndarray:
    """Return depth in uint16 millimetres as float32 metres; NaN = unknown (0)."""
    depth_m = depth_mm * np.float32(1e-3)
    depth_m[depth_mm == 0] = np.nan
    return depth_m


def sigma_to_codes(sigma_m: np.ndarray) -> np.ndarray:
    """Return standard deviations (m) as codes uint8: 16 per doubling, from 1 = 1 mm to 255 = 60 m.

    Values outside are clipped; 0 = unknown (NaN, or not positive).
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        code = np.log2(sigma_m * np.float32(1.0 / _SIGMA_M)) * np.float32(_PER_OCTAVE) + np.float32(1.5)
        known = sigma_m > 0.0
    return np.where(known, np.clip(code, 1.0, 255.0), np.float32(0.0)).astype(np.uint8)


def _pack(values: np.ndarray) -> np.ndarray:
    if values.ndim != 2 or not all(0 < size <= 16384 for size in values.shape):
        raise ValueError(f"depth, sigma and masks are [H, W], at most 16384 x 16384, not {values.shape}")
    signed = np.dtype(f"int{8 * values.itemsize}")
    residual = values.copy()
    residual[1:] -= values[:-1]  # modulo 256 or 65536
    difference = residual.view(signed)
    folded = (difference << 1) ^ (difference >> (8 * values.itemsize - 1))
    planes = np.ascontiguousarray(folded.view(np.uint8).reshape(-1, values.itemsize).T)
    head = _HEAD.pack(_MAGIC, values.itemsize, *values.shape)
    return np.frombuffer(head + zstandard.compress(planes.data, _LEVEL), np.uint8)


def _unpack(packed: np.ndarray, shape: tuple[int, int] | None, dtype: np.dtype, what: str) -> np.ndarray:
    itemsize, *found = _head(packed, what)
    if itemsize != dtype.itemsize or (shape is not None and tuple(found) != shape):
        wanted = "any size" if shape is None else f"{shape[1]}x{shape[0]}"
        raise ValueError(
            f"{what}: {itemsize} bytes per pixel and {found[1]}x{found[0]} pixels, "
            f"expected {dtype.itemsize} and {wanted}"
        )
    body, size = packed.data[_HEAD.size :], itemsize * found[0] * found[1]
    try:
        # Read first: zstd allocates what a frame states, which can be gigabytes.
        if zstandard.frame_content_size(body) != size:
            raise ValueError(f"{what}: the compressed data do not have {found[1]}x{found[0]} pixels")
        planes = np.frombuffer(zstandard.decompress(body), np.uint8).reshape(itemsize, -1)
    except zstandard.ZstdError as error:
        raise ValueError(f"{what}: does not decompress: {error}") from error
    folded = np.ascontiguousarray(planes.T).reshape(-1).view(dtype).reshape(found)
    residual = (folded >> 1) ^ (np.zeros((), dtype) - (folded & 1))  # unsigned: 0 - 1 is all ones
    return np.cumsum(residual, axis=0, dtype=dtype)


def _head(packed: np.ndarray, what: str) -> tuple[int, int, int]:
    """Return bytes per value, height and width."""
    if len(packed) < _HEAD.size:
        raise ValueError(f"{what}: {len(packed)} bytes are too few")
    magic, itemsize, height, width = _HEAD.unpack_from(packed.data)
    if magic != _MAGIC:
        raise ValueError(f"{what}: the data start with {magic!r}, which is no depth map or mask")
    if not 0 < height * width <= MAX_PIXELS:
        raise ValueError(f"{what}: {width}x{height} pixels, at most {MAX_PIXELS}")
    return itemsize, height, width


def _is_png(packed: np.ndarray) -> bool:
    return packed[:4].tobytes() == _PNG
