"""PNG encoding of depth maps and masks, for exports; reading of the PNGs in keyframes of earlier versions.

Messages contain the encoding of `depth_codec`, with the same quantisation.
"""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.messages.image_codec import decode_compressed

_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # zlib level


def depth_to_png(depth_mm: np.ndarray) -> np.ndarray:
    """Encode depth uint16 [H, W] (mm, 0 = unknown) as a PNG, returned as uint8 [B]."""
    return cv2.imencode(".png", depth_mm, _FAST)[1].ravel()


def depth_mm_from_png(png: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Decode depth uint16 [H, W] (mm, 0 = unknown), of this shape, from a PNG uint8 [B].

    Raises:
        ValueError: the bytes are not a PNG of 16 bits and one channel, or has another shape.
    """
    return _decode(png, shape, np.uint16, "depth")


def sigma_codes_from_png(png: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Decode codes of standard deviations uint8 [H, W] (`depth_codec.sigma_to_codes`) from a PNG uint8 [B].

    Raises:
        ValueError: the bytes are not a PNG of 8 bits and one channel, or has another shape.
    """
    return _decode(png, shape, np.uint8, "sigma")


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
