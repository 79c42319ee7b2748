"""Depth from the parallax of the images themselves, in an arbitrary unit, for use without a depth source.

Initialisation: the first image is assumed to show a fronto-parallel plane at depth INITIAL_DEPTH. Tracking
against it yields poses; a plane sweep with these poses yields depth of the first image; better depth yields
better poses. INIT_ROUNDS repetitions suffice. INITIAL_DEPTH fixes the unit. Later keyframes get their depth
from the images before them.
"""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.localization.camera.plane_sweep import fill_unknown, sweep

INITIAL_DEPTH = 2.0  # assumed depth of the first image; defines the unit of the map
INIT_ROUNDS = 4
INIT_BASELINES = (0.03, 0.06, 0.10, 0.14)  # baseline of each round, relative to INITIAL_DEPTH
_MIN_BASELINE_RATIO = 0.025  # relative to the typical depth
_MAX_OTHER_IMAGES = 3
_FILL_PX = 4.0  # sigma of the interpolation of unknown depth
_NEAREST_RATIO, _FARTHEST_RATIO = 0.2, 6.0  # range of the plane sweep, relative to the typical depth

# (grey float32 [h, w] at half of the finest size, T_map_camera)
PosedImage = tuple[np.ndarray, np.ndarray]


def select_other_images(
    here: PosedImage, candidates: list[PosedImage], usual_depth: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Select up to three of the candidates for the plane sweep, with different baselines, the widest first.

    Returns:
        (grey float32 [h, w], T_other_here float64 [4, 4]) of each. Candidates with a baseline that is short
        compared with `usual_depth`, or with another viewing direction, are not used.
    """
    found = []
    for grey, T_map_camera in candidates:
        T_other_here = inverse(T_map_camera) @ here[1]
        baseline = float(np.linalg.norm(T_other_here[:3, 3]))
        if baseline > _MIN_BASELINE_RATIO * usual_depth and T_other_here[2, 2] > 0.85:
            found.append((baseline, grey, T_other_here))
    found.sort(key=lambda entry: -entry[0])
    picked = [
        found[i] for i in np.unique(np.linspace(0, len(found) - 1, _MAX_OTHER_IMAGES).round().astype(int))
    ]
    return [(grey, T) for _, grey, T in picked] if found else []


def depth_from_parallax(
    here: PosedImage, candidates: list[PosedImage], camera: RasterCamera, usual_depth: float
) -> np.ndarray:
    """Return the optical z float32 [h, w] of the image `here`, 0 where the parallax does not determine it.

    `usual_depth` is the typical optical z; the plane sweep covers a range around this depth. `camera` has the
    size of the images.
    """
    others = select_other_images(here, candidates, usual_depth) if candidates else []
    if not others:
        return np.zeros(here[0].shape, np.float32)
    z = sweep(here[0], others, camera, _NEAREST_RATIO * usual_depth, _FARTHEST_RATIO * usual_depth)
    return _remove_outliers(z)


def dense(z: np.ndarray, shown: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Combine two depth maps (0 = unknown) into one without gaps, float32 with the size `shape` (H, W).

    Every pixel has the depth `z` of the plane sweep if known, else the depth `shown` that was rendered from
    the map, else a depth interpolated from other pixels.
    """
    h, w = z.shape
    known = cv2.resize(shown, (w, h), interpolation=cv2.INTER_NEAREST)
    both = fill_unknown(np.where(z > 0.0, z, known), _FILL_PX)
    return cv2.resize(both, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST)


def _remove_outliers(z: np.ndarray) -> np.ndarray:
    """Return the depth with pixels set to 0 whose inverse depth differs from the mean of 9 x 9 pixels."""
    q = np.where(z > 0.0, 1.0 / np.maximum(z, 1e-6), 0.0).astype(np.float32)
    weight = cv2.blur((z > 0.0).astype(np.float32), (9, 9))
    mean = cv2.blur(q, (9, 9)) / np.maximum(weight, 1e-6)
    agree = (weight > 0.25) & (np.abs(q - mean) < 0.25 * mean)
    return np.where(agree, z, 0.0).astype(np.float32)
