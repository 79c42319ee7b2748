"""All textures of a scene with mip levels in one flat array, for the compiled sampler.

Texels are stored as round(255 * sqrt(linear)): 8 bits with fine steps in dark tones, decoded by one
multiplication. Mip levels are averaged in linear light.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

MAX_LEVELS = 12


@dataclass(frozen=True)
class Atlas:
    """T textures, each with its mip levels; all levels together have N texels."""

    names: tuple[str, ...]
    size_m: np.ndarray  # float64 [T, 2] width and height in metres of one repeat
    texels: np.ndarray  # uint8 [N, 3], sqrt-encoded linear RGB
    offset: np.ndarray  # int32 [T, MAX_LEVELS], index in `texels` of the first texel of each level
    width_px: np.ndarray  # int32 [T, MAX_LEVELS]
    height_px: np.ndarray  # int32 [T, MAX_LEVELS]
    levels: np.ndarray  # int32 [T], number of mip levels
    mean: np.ndarray  # float32 [T, 3] average linear colour

    def index(self, name: str) -> int:
        """Return the index 0..T-1 of the texture called `name`."""
        return self.names.index(name)


def srgb_to_linear(srgb: np.ndarray) -> np.ndarray:
    """Convert sRGB values 0..1 to linear values 0..1 (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Convert linear values 0..1 to sRGB values 0..1 (IEC 61966-2-1)."""
    linear = np.maximum(linear, 0.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def build_atlas(textures: dict[str, tuple[np.ndarray, tuple[float, float]]]) -> Atlas:
    """Return the atlas of `textures`, a dictionary from the name to the pixels and the size of a texture.

    Pixels are sRGB float32 [H, W, 3], row 0 on top; the size is the width and height in metres of one repeat.
    """
    names = tuple(textures)
    shape = (len(names), MAX_LEVELS)
    offset, widths, heights = (np.zeros(shape, np.int32) for _ in range(3))
    levels, mean = np.zeros(len(names), np.int32), np.zeros((len(names), 3), np.float32)
    chunks, start = [], 0
    for k, name in enumerate(names):
        level: np.ndarray = srgb_to_linear(textures[name][0].astype(np.float32)).astype(np.float32)
        mean[k] = level.mean(axis=(0, 1))
        for j in range(MAX_LEVELS):
            height, width = level.shape[:2]
            offset[k, j], widths[k, j], heights[k, j] = start, width, height
            chunks.append(np.rint(255.0 * np.sqrt(level)).astype(np.uint8).reshape(-1, 3))
            start += height * width
            levels[k] = j + 1
            if max(height, width) == 1:
                break
            level = cv2.resize(
                level, (max(1, width // 2), max(1, height // 2)), interpolation=cv2.INTER_AREA
            ).reshape(max(1, height // 2), max(1, width // 2), 3)
    sizes = np.array([textures[name][1] for name in names], dtype=np.float64)
    return Atlas(names, sizes, np.concatenate(chunks), offset, widths, heights, levels, mean)
