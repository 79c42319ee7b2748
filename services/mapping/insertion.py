"""Insertion of Gaussians at pixels that the map does not explain: flat discs at the measured depth."""

from __future__ import annotations

import numpy as np

from beamsplat.common.engines.coverage import differing_pixels
from beamsplat.common.raster.discs import choose_pixels, make_discs
from beamsplat.services.mapping.keyframe import PyramidLevel
from beamsplat.services.mapping.settings import MapperSettings

_TRUSTED_WEIGHT = 128  # of 255: depth that can show an error of the map (weight 1/2)
_COVERED_ALPHA = 0.9  # from which the map counts as covering a pixel


def unexplained_pixels(
    image: np.ndarray,  # float32 [5, H, W] as rendered: r, g, b, accumulated depth, alpha
    level: PyramidLevel,
    settings: MapperSettings,
) -> np.ndarray:
    """Return bool [H, W]: pixels where the render is transparent, or its colour or trusted depth is wrong."""
    rgb = level.rgb.astype(np.float32) * np.float32(1 / 255)
    depth = level.depth_mm.astype(np.float32) * np.float32(1e-3)
    return differing_pixels(
        image, rgb, depth, level.depth_weight >= _TRUSTED_WEIGHT, min_alpha=settings.min_alpha,
        max_colour_error=settings.max_colour_error, max_depth_error=settings.max_depth_error,
    )  # fmt: skip


def new_gaussians(
    missing: np.ndarray,  # bool [H, W]
    level: PyramidLevel,
    T_map_camera: np.ndarray,
    settings: MapperSettings,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Create Gaussians at a subset of the `missing` pixels with a known depth.

    Returns:
        u and v, int [N] each: the pixels (px). The Gaussians, float32 [14, N], in the map frame.
    """
    s = settings
    grey = level.rgb.astype(np.float32).mean(axis=0) * np.float32(1 / 255)
    texture = s.texture * 8.0 / s.stride_px  # the Sobel response is 8 times the step to the next pixel
    wanted = missing & (level.depth_mm > 0)
    u, v, spacing = choose_pixels(wanted, grey, s.stride_px, s.fine_stride_px, texture)
    z_m = level.depth_mm.astype(np.float32) * np.float32(1e-3)
    rgb = level.rgb[:, v, u] * np.float32(1 / 255)
    discs = make_discs(
        u, v, spacing, z_m, rgb, level.camera, T_map_camera,
        size=s.size, flatness=s.flatness, opacity=s.opacity, least_slant=s.least_slant,
    )  # fmt: skip
    return u, v, discs


def prediction_quality(image: np.ndarray, level: PyramidLevel) -> tuple[float, float]:
    """Compare the render of the map with a new image, before the image is inserted.

    Args:
        image: float32 [5, H, W], the render at the pose of the image: r, g, b, accumulated depth, alpha.
        level: the new image.

    Returns:
        The fraction of the pixels that the map covers, and the PSNR (dB) of the render at these pixels; NaN
        if less than 1 % is covered.
    """
    covered = image[4] > _COVERED_ALPHA
    if level.hidden is not None:
        covered &= ~level.hidden
    fraction = float(covered.mean())
    if fraction < 0.01:
        return fraction, float("nan")
    error = np.clip(image[:3, covered], 0.0, 1.0) - level.rgb[:, covered] * np.float32(1 / 255)
    return fraction, float(-10.0 * np.log10(max(float(np.mean(error**2)), 1e-12)))
