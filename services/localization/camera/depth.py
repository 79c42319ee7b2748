"""What becomes of a picture's depth before it may enter the map: its size, its edges, its scale."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

MAX_DEPTH = 60.0
_EDGE = 0.06  # relative step between neighbours that is an edge: a pixel there belongs to neither side
_BLUR_SHARE = 0.12  # of the picture's width: reach of what the map knows into what it does not
_LEAST_OVERLAP = 0.05  # share of the picture that must be known to both, to compare scales
_MAP_SCALE_SIGMA = 0.03  # of the log scale at which the map shows what it has seen before


@dataclass(frozen=True)
class DepthGuess:
    """Depth of one picture, as its source gives it."""

    z: np.ndarray  # float32 [H, W], optical z, NaN unknown; any size of the picture's shape
    scale_sigma: float  # standard deviation of the log of its scale, from picture to picture
    metric: bool  # its unit is the metre


def shrunk(z: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    """float32 [height_px, width_px], 0 where unknown or at an edge, of depth [H, W] with NaN.

    Inverse depth is averaged, which a plane survives; at edges, where the mean of two surfaces is neither,
    there is none.
    """
    with np.errstate(invalid="ignore"):
        known = np.isfinite(z) & (z > 0.05) & (z < MAX_DEPTH)
        inverse_z = np.where(known, 1.0 / z, 0.0).astype(np.float32)
    mean = cv2.resize(inverse_z, (width_px, height_px), interpolation=cv2.INTER_AREA)
    whole = cv2.resize(known.astype(np.float32), (width_px, height_px), interpolation=cv2.INTER_AREA) > 0.999
    small = np.where(whole, 1.0 / np.maximum(mean, 1e-6), 0.0).astype(np.float32)
    far, near = cv2.dilate(small, np.ones((3, 3))), cv2.erode(small, np.ones((3, 3)))
    return np.where((near > 0.0) & (far - near < _EDGE * 2.0 * np.maximum(near, 1e-6)), small, 0.0)


def fitted_to_map(
    z: np.ndarray,  # float32 [h, w], 0 unknown
    rendered_z: np.ndarray,  # float32 [h, w] of the map from there, 0 unknown
    scale_sigma: float,
) -> tuple[np.ndarray, float]:
    """Depth brought to the scale at which the map continues, and the log ratio found (NaN if none).

    A source that is sure of its scale keeps it; one that is not follows the map, smoothly varying over the
    picture: a keyframe must not begin beside the surface where the map ends.
    """
    both = (z > 0.0) & (rendered_z > 0.0)
    if both.mean() < _LEAST_OVERLAP:
        return z, float("nan")
    log_ratio = np.zeros(z.shape, np.float32)
    log_ratio[both] = np.log(z[both] / rendered_z[both])
    middle = float(np.median(log_ratio[both]))
    spread = max(1.4826 * float(np.median(np.abs(log_ratio[both] - middle))), 0.02)
    good = both & (np.abs(log_ratio - middle) < 3.0 * spread)
    trust = scale_sigma**2 / (scale_sigma**2 + _MAP_SCALE_SIGMA**2)
    sigma_px = _BLUR_SHARE * z.shape[1]
    weight = cv2.GaussianBlur(good.astype(np.float32), (0, 0), sigma_px)
    local = cv2.GaussianBlur(np.where(good, log_ratio, middle * 0.0), (0, 0), sigma_px)
    prior = 0.05  # so much of the whole picture's answer, where little is known nearby
    field = (local + prior * middle) / (weight + prior)
    return (z * np.exp(-trust * field)).astype(np.float32), middle
