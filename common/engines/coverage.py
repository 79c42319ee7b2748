"""Where a rendered map does not explain an image: there Gaussians are inserted."""

from __future__ import annotations

import cv2
import numpy as np


def differing_pixels(
    image: np.ndarray,  # float32 [5, H, W] as rendered: r, g, b, accumulated depth, alpha
    rgb: np.ndarray,  # float32 [3, H, W] in [0, 1]
    z_m: np.ndarray,  # float32 [H, W] optical z
    trusted: np.ndarray,  # bool [H, W]: pixels whose depth is compared
    *,
    min_alpha: float,
    max_colour_error: float,
    max_depth_error: float,  # relative
) -> np.ndarray:
    """Return bool [H, W]: pixels where the render is transparent, or its colour or trusted depth is wrong."""
    alpha = image[4]
    # Averaged over 5 px: edges displaced by half a pixel are left to the optimiser.
    colour_off = cv2.blur(np.abs(image[:3] - rgb).mean(axis=0), (5, 5)) > max_colour_error
    expected = image[3] / np.maximum(alpha, 1e-3)
    depth_off = (trusted & (np.abs(expected - z_m) > max_depth_error * z_m)).astype(np.uint8)
    depth_off = cv2.erode(depth_off, np.ones((5, 5), np.uint8)) > 0
    return (alpha < min_alpha) | colour_off | depth_off
