"""Compact encoding of Gaussians for viewers and remote copies of the map.

17 bytes per Gaussian before zlib compression: means are quantised to 1/65535 of the chunk's extent, scales to
2.4 %, rotations to half a degree, opacity and colour to 1/255. Parameter rows are those of
beamsplat.common.raster.layout.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, PARAMS, QUAT, SCALE

MAX_GAUSSIANS = 8_000_000  # per chunk: limits the memory that a received message can allocate
_HEAD = struct.Struct("<4sI6f")  # magic, count, minimum and maximum corner of the means
_MAGIC = b"SPL1"
_BYTES = 17  # per Gaussian
_LOG_SCALE = (-9.2, 2.9)  # range of ln(scale in m): 0.1 mm to 18 m
_LOGIT = 8.0  # range of the opacity logit: opacity 0.0003 to 0.9997


def pack(params: np.ndarray) -> np.ndarray:
    """Encode Gaussians float32 [14, N] as bytes uint8 [B]."""
    count = params.shape[1]
    mean = params[MEAN:SCALE].astype(np.float64)
    low = mean.min(axis=1) if count else np.zeros(3)
    high = mean.max(axis=1) if count else np.zeros(3)
    # Quantise with the float32 corners that are written, because the decoder uses those.
    low, high = low.astype(np.float32), high.astype(np.float32)
    extent = np.maximum(high.astype(np.float64) - low, 1e-9)
    grid = np.clip((mean - low[:, None]) / extent[:, None] * 65535.0 + 0.5, 0.0, 65535.0).astype("<u2")
    s0, s1 = _LOG_SCALE
    scale = _to_byte((params[SCALE:QUAT] - s0) / (s1 - s0))
    quat = params[QUAT:OPACITY].astype(np.float64)
    quat = quat / np.maximum(np.linalg.norm(quat, axis=0), 1e-12)
    turned = np.clip(np.round(quat * 127.0), -127, 127).astype(np.int8)
    opacity = _to_byte(1.0 / (1.0 + np.exp(-np.clip(params[OPACITY], -_LOGIT, _LOGIT))))
    colour = _to_byte(params[COLOUR:])
    # Group bytes of one kind, high and low bytes apart: similar neighbouring bytes compress better.
    high_byte, low_byte = (grid >> 8).astype(np.uint8), (grid & 255).astype(np.uint8)
    planes = [high_byte, low_byte, scale, turned.view(np.uint8), opacity[None], colour]
    body = zlib.compress(np.concatenate(planes).tobytes(), 1)
    return np.frombuffer(_HEAD.pack(_MAGIC, count, *low, *high) + body, np.uint8)


def extent_of(packed: bytes) -> tuple[int, np.ndarray, np.ndarray]:
    """Return count, lowest and highest corner float64 [3] of the means, from the header of packed Gaussians.

    Raises:
        ValueError: the bytes do not begin with a valid header.
    """
    if len(packed) < _HEAD.size:
        raise ValueError(f"{len(packed)} bytes are too few for packed Gaussians")
    magic, count, *corners = _HEAD.unpack_from(packed)
    if magic != _MAGIC or count > MAX_GAUSSIANS or not np.all(np.isfinite(corners)):
        raise ValueError(f"not packed Gaussians: the data starts with {magic!r} and a count of {count}")
    return count, np.array(corners[:3]), np.array(corners[3:])


def unpack(packed: np.ndarray) -> np.ndarray:
    """Decode the bytes of `pack` to Gaussians float32 [14, N].

    Raises:
        ValueError: the bytes are invalid, truncated, or have more than `MAX_GAUSSIANS` Gaussians.
    """
    blob = packed.tobytes()
    count, lowest, highest = extent_of(blob)
    try:
        body = zlib.decompressobj().decompress(blob[_HEAD.size :], _BYTES * count + 1)
    except zlib.error as error:
        raise ValueError(f"packed Gaussians do not decompress: {error}") from error
    if len(body) != _BYTES * count:
        raise ValueError(f"packed Gaussians: {len(body)} bytes for {count} of {_BYTES} bytes each")
    planes = np.frombuffer(body, np.uint8).reshape(_BYTES, count)
    low, high = lowest[:, None], highest[:, None]
    grid = planes[0:3].astype(np.float64) * 256.0 + planes[3:6]
    out = np.empty((PARAMS, count), np.float32)
    out[MEAN:SCALE] = low + grid / 65535.0 * np.maximum(high - low, 1e-9)
    s0, s1 = _LOG_SCALE
    out[SCALE:QUAT] = s0 + planes[6:9].astype(np.float32) / 255.0 * (s1 - s0)
    quat = planes[9:13].view(np.int8).astype(np.float32)
    out[QUAT:OPACITY] = quat / np.maximum(np.linalg.norm(quat, axis=0), 1e-6)
    opacity = np.clip(planes[13].astype(np.float64) / 255.0, 1e-3, 1.0 - 1e-3)
    out[OPACITY] = np.log(opacity / (1.0 - opacity))
    out[COLOUR:] = planes[14:17].astype(np.float32) / 255.0
    return out


def _to_byte(share: np.ndarray) -> np.ndarray:
    return np.clip(share * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)
