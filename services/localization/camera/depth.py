"""Preparation of an image's depth map for the splat map: resampling, removal of edges, scale alignment."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

MAX_DEPTH_M = 60.0
_EDGE_RELATIVE_STEP = 0.06  # relative depth step of a depth edge; pixels at an edge mix two surfaces
_BLUR_WIDTH_RATIO = 0.12  # of the image width: sigma of the blur that extends the scale field
_MIN_OVERLAP = 0.05  # fraction of the image where both depths must be known to compare scales
_MAP_SCALE_SIGMA = 0.03  # standard deviation of the map's own log scale


@dataclass(frozen=True)
class DepthPrior:
    """Depth map of one image, as measured or estimated by a depth source, with its scale uncertainty."""

    z: np.ndarray  # float32 [H, W], optical z, NaN = unknown; any size with the image's aspect ratio
    scale_sigma: float  # standard deviation of the log scale between images
    metric: bool  # True: metres; False: arbitrary unit


def resize_depth(z: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    """Resample a depth map [H, W] (NaN = unknown) to float32 [height_px, width_px] (0 = unknown).

    Pixels at depth edges become unknown, because the mean depth of two surfaces is on neither of them.
    Inverse depth is averaged, because the inverse depth of a plane is a linear function of the pixel.
    """
    with np.errstate(invalid="ignore"):
        known = np.isfinite(z) & (z > 0.05) & (z < MAX_DEPTH_M)
        inverse_z = np.where(known, 1.0 / z, 0.0).astype(np.float32)
    mean = cv2.resize(inverse_z, (width_px, height_px), interpolation=cv2.INTER_AREA)
    whole = cv2.resize(known.astype(np.float32), (width_px, height_px), interpolation=cv2.INTER_AREA) > 0.999
    small = np.where(whole, 1.0 / np.maximum(mean, 1e-6), 0.0).astype(np.float32)
    far, near = cv2.dilate(small, np.ones((3, 3))), cv2.erode(small, np.ones((3, 3)))
    return np.where(
        (near > 0.0) & (far - near < _EDGE_RELATIVE_STEP * 2.0 * np.maximum(near, 1e-6)), small, 0.0
    )


def align_scale_to_map(
    z: np.ndarray,  # float32 [h, w], 0 unknown
    rendered_z: np.ndarray,  # float32 [h, w] of the map rendered at the same pose, 0 unknown
    scale_sigma: float,
) -> tuple[np.ndarray, float]:
    """Scale the depth of an image so that it agrees with the depth of the map.

    The larger `scale_sigma` (standard deviation of the depth's log scale), the closer the result is to the
    map; depth with an exact scale is not changed. The factor varies smoothly over the image, so that the
    surface of a new keyframe continues the surface of the map without a step.

    Returns:
        The scaled depth float32 [h, w], and the median of log(z / rendered_z) before scaling. The median is
        NaN, and the depth unchanged, where both depths are known in too few pixels.
    """
    both = (z > 0.0) & (rendered_z > 0.0)
    if both.mean() < _MIN_OVERLAP:
        return z, float("nan")
    log_ratio = np.zeros(z.shape, np.float32)
    log_ratio[both] = np.log(z[both] / rendered_z[both])
    middle = float(np.median(log_ratio[both]))
    spread = max(1.4826 * float(np.median(np.abs(log_ratio[both] - middle))), 0.02)
    good = both & (np.abs(log_ratio - middle) < 3.0 * spread)
    trust = scale_sigma**2 / (scale_sigma**2 + _MAP_SCALE_SIGMA**2)
    sigma_px = _BLUR_WIDTH_RATIO * z.shape[1]
    weight = cv2.GaussianBlur(good.astype(np.float32), (0, 0), sigma_px)
    local = cv2.GaussianBlur(np.where(good, log_ratio, middle * 0.0), (0, 0), sigma_px)
    prior = 0.05  # weight of the image's median, where little overlap is nearby
    field = (local + prior * middle) / (weight + prior)
    return (z * np.exp(-trust * field)).astype(np.float32), middle
