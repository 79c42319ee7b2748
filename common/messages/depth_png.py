"""PNG encoding of depth maps, their standard deviations, and masks, as used in keyframes."""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.messages.image_codec import decode_compressed

_SIGMA_M = 1e-3  # sigma of code 1
_PER_OCTAVE = 16  # codes per doubling of sigma: the quantisation error is at most 2.2 %
_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # zlib level


def depth_to_png(depth_m: np.ndarray) -> np.ndarray:
    """Encode depth float32 [H, W] (m) as a PNG of uint16 millimetres, returned as uint8 [B].

    NaN and values outside (0, 65) m are encoded as 0 = unknown.
    """
    with np.errstate(invalid="ignore"):
        fits = (depth_m > 0.0) & (depth_m < 65.0)
    mm = np.where(fits, np.nan_to_num(depth_m) * 1e3 + 0.5, 0.0).astype(np.uint16)
    return cv2.imencode(".png", mm, _FAST)[1].ravel()


def depth_from_png(png: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Decode depth float32 [H, W] (m), of this shape, from a PNG uint8 [B]; NaN = unknown.

    Raises:
        ValueError: the bytes are not a PNG of 16 bits and one channel, or has another shape.
    """
    mm = _decode(png, shape, np.uint16, "depth")
    return np.where(mm > 0, mm * np.float32(1e-3), np.float32(np.nan)).astype(np.float32)


def sigma_to_png(sigma_m: np.ndarray) -> np.ndarray:
    """Encode standard deviations float32 [H, W] (m) as a PNG of logarithmic codes, returned as uint8 [B].

    Codes 1 to 255 range from 1 mm to about 60 m; 0 = unknown (NaN).
    """
    with np.errstate(invalid="ignore"):
        known = sigma_m > 0.0
    octaves = np.log2(np.where(known, sigma_m, _SIGMA_M) / _SIGMA_M)
    code = np.where(known, np.clip(np.round(octaves * _PER_OCTAVE) + 1.0, 1.0, 255.0), 0.0)
    return cv2.imencode(".png", code.astype(np.uint8), _FAST)[1].ravel()


def sigma_from_png(png: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Decode standard deviations float32 [H, W] (m), of this shape, from a PNG uint8 [B]; NaN = unknown.

    Raises:
        ValueError: the bytes are not a PNG of 8 bits and one channel, or has another shape.
    """
    code = _decode(png, shape, np.uint8, "sigma")
    sigma = _SIGMA_M * np.exp2((code.astype(np.float32) - 1.0) / _PER_OCTAVE)
    return np.where(code > 0, sigma, np.float32(np.nan)).astype(np.float32)


def mask_to_png(mask: np.ndarray) -> np.ndarray:
    """Encode a mask bool [H, W] as a PNG of 0 and 255, returned as uint8 [B]."""
    return cv2.imencode(".png", mask.astype(np.uint8) * 255, _FAST)[1].ravel()


def mask_from_png(png: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Decode a mask bool [H, W], of this shape, from a PNG uint8 [B].

    Raises:
        ValueError: the bytes are not a PNG of 8 bits and one channel, or has another shape.
    """
    return _decode(png, shape, np.uint8, "mask") > 127


def _decode(png: np.ndarray, shape: tuple[int, int], dtype: type, what: str) -> np.ndarray:
    try:
        image = decode_compressed(png, "png", shape[1], shape[0], cv2.IMREAD_UNCHANGED)
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from error
    if image.dtype != dtype or image.ndim != 2:
        found = f"{image.dtype} {list(image.shape)}"
        raise ValueError(f"{what}: expected a PNG of {np.dtype(dtype).name} [H, W], found {found}")
    return image
