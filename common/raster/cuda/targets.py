"""A keyframe's targets at one image size as one block of bytes: one copy brings them to the device.

uint16 [H, W]      measured optical z, mm, 0 = unknown
uint8 [3, H, W]    red, green, blue
uint8 [H, W]       weight of the depth, 255 = weight 1
uint8 [H, W]       hidden pixels (not 0): on a dynamic object, ignored by all losses
...                zeros up to a multiple of 16 bytes
int32 [4]          K pixels with lidar beams, B beams, 0, 0
int32 [K]          these pixels, ascending
int32 [K]          for each, the end of its beams in the next array
float32 [B]        optical z (m) of the beams, sorted by pixel: one thread adds all beams of a pixel
"""

from __future__ import annotations

import numpy as np

_ALIGNMENT = 16


def pixel_bytes(width_px: int, height_px: int) -> int:
    """Return the size of the images in the block, bytes: the beams begin there."""
    return -(-7 * width_px * height_px // _ALIGNMENT) * _ALIGNMENT


def pack_targets(
    rgb: np.ndarray,  # uint8 [3, H, W]
    depth_mm: np.ndarray,  # uint16 [H, W]
    depth_weight: np.ndarray,  # uint8 [H, W]
    hidden: np.ndarray | None,  # bool [H, W], None = no pixel
    beam_pixels: np.ndarray,  # int32 [B], flat pixel indices
    beam_z_m: np.ndarray,  # float32 [B]
) -> np.ndarray:
    """Return the targets as uint8 [bytes], see the module.

    Beams of one pixel keep their order.

    Raises:
        ValueError: an array has another shape, or a beam is outside the image.
    """
    height, width = depth_mm.shape
    if rgb.shape != (3, height, width) or depth_weight.shape != (height, width):
        raise ValueError(f"targets differ in size: {rgb.shape}, {depth_mm.shape}, {depth_weight.shape}")
    if len(beam_pixels) and not 0 <= beam_pixels.min() <= beam_pixels.max() < height * width:
        raise ValueError("a lidar beam is outside the image")
    order = np.argsort(beam_pixels, kind="stable")
    pixels, counts = np.unique(beam_pixels, return_counts=True)
    masked = np.zeros((height, width), np.uint8) if hidden is None else hidden.astype(np.uint8)
    images = b"".join(
        np.ascontiguousarray(array, dtype).tobytes()
        for array, dtype in (
            (depth_mm, np.uint16),
            (rgb, np.uint8),
            (depth_weight, np.uint8),
            (masked, np.uint8),
        )
    )
    head = np.array((len(pixels), len(beam_pixels), 0, 0), np.int32)
    beams = (
        head,
        pixels.astype(np.int32),
        np.cumsum(counts).astype(np.int32),
        beam_z_m[order].astype(np.float32),
    )
    padding = bytes(pixel_bytes(width, height) - len(images))
    return np.frombuffer(bytearray(images + padding + b"".join(part.tobytes() for part in beams)), np.uint8)
