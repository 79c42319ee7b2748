"""New Gaussians where the map does not explain a picture: discs on the surface that the depth shows."""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.raster.discs import choose_pixels, make_discs
from beamsplat.services.mapping.keyframe import Level
from beamsplat.services.mapping.settings import MapperSettings


def unexplained(
    image: np.ndarray,  # float32 [5, H, W] as rendered
    level: Level,
    settings: MapperSettings,
) -> np.ndarray:
    """bool [H, W]: seen through, of another colour, or at another depth than a trusted measurement."""
    alpha = image[4]
    rgb = level.rgb.astype(np.float32) * np.float32(1 / 255)
    # Over a few pixels: thin edges that lie half a pixel off are for the optimiser, not for new Gaussians.
    colour_off = cv2.blur(np.abs(image[:3] - rgb).mean(axis=0), (5, 5)) > settings.colour_off
    depth = level.depth_mm.astype(np.float32) * np.float32(1e-3)
    expected = image[3] / np.maximum(alpha, 1e-3)
    trusted = level.depth_weight >= 128
    depth_off = (trusted & (np.abs(expected - depth) > settings.depth_off * depth)).astype(np.uint8)
    depth_off = cv2.erode(depth_off, np.ones((5, 5), np.uint8)) > 0
    return (alpha < settings.alpha_low) | colour_off | depth_off


def new_gaussians(
    missing: np.ndarray,  # bool [H, W]
    level: Level,
    T_map_camera: np.ndarray,
    settings: MapperSettings,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u int [N], v int [N], float32 [14, N]): Gaussians for missing pixels that have a depth."""
    s = settings
    grey = level.rgb.astype(np.float32).mean(axis=0) * np.float32(1 / 255)
    texture = s.texture * 8.0 / s.stride_px  # Sobel's sums are eight times the step to the next pixel
    wanted = missing & (level.depth_mm > 0)
    u, v, spacing = choose_pixels(wanted, grey, s.stride_px, s.fine_stride_px, texture)
    z_m = level.depth_mm.astype(np.float32) * np.float32(1e-3)
    rgb = level.rgb[:, v, u] * np.float32(1 / 255)
    discs = make_discs(
        u, v, spacing, z_m, rgb, level.camera, T_map_camera,
        size=s.size, flatness=s.flatness, opacity=s.opacity, least_slant=s.least_slant,
    )  # fmt: skip
    return u, v, discs


def foretold(image: np.ndarray, level: Level) -> tuple[float, float]:
    """Share of the pixels that the render float32 [5, H, W] covers, and its PSNR (dB) there."""
    covered = image[4] > 0.9
    if level.hidden is not None:
        covered &= ~level.hidden
    share = float(covered.mean())
    if share < 0.01:
        return share, float("nan")
    error = np.clip(image[:3, covered], 0.0, 1.0) - level.rgb[:, covered] * np.float32(1 / 255)
    return share, float(-10.0 * np.log10(max(float(np.mean(error**2)), 1e-12)))
