"""Depth where nobody gives any: from the pictures' own parallax, in a unit that is nobody's.

The first picture is taken for a wall. What the camera then does before it gives first poses, those give the
first picture's depth by a plane sweep, that gives better poses, and so on: a few rounds settle it. The unit
is fixed by the wall's distance. Later keyframes get depth from the pictures before them.
"""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.localization.camera.sweep import filled, sweep

WALL = 2.0  # distance of the first wall: the unit
ROUNDS = 4
FIRST_BASELINES = (0.03, 0.06, 0.10, 0.14)  # of the wall's distance, one a round
_LEAST_BASELINE = 0.025  # of the usual depth
_MOST_OTHERS = 3
_FILL_PX = 4.0
_NEAREST, _FARTHEST = 0.2, 6.0  # times the usual depth

# (grey float32 [h, w] at half the finest size, T_map_camera)
Look = tuple[np.ndarray, np.ndarray]


def choose_others(
    here: Look, candidates: list[Look], usual_depth: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(grey, T_other_here) of up to three looks with different baselines, the widest first."""
    found = []
    for grey, T_map_camera in candidates:
        T_other_here = inverse(T_map_camera) @ here[1]
        baseline = float(np.linalg.norm(T_other_here[:3, 3]))
        if baseline > _LEAST_BASELINE * usual_depth and T_other_here[2, 2] > 0.85:
            found.append((baseline, grey, T_other_here))
    found.sort(key=lambda entry: -entry[0])
    picked = [found[i] for i in np.unique(np.linspace(0, len(found) - 1, _MOST_OTHERS).round().astype(int))]
    return [(grey, T) for _, grey, T in picked] if found else []


def depth_by_motion(
    here: Look, candidates: list[Look], camera: RasterCamera, usual_depth: float
) -> np.ndarray:
    """float32 [h, w], 0 where there is no parallax to tell it by."""
    others = choose_others(here, candidates, usual_depth) if candidates else []
    if not others:
        return np.zeros(here[0].shape, np.float32)
    z = sweep(here[0], others, camera, _NEAREST * usual_depth, _FARTHEST * usual_depth)
    return _without_loners(z)


def dense(z: np.ndarray, shown: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """float32 `shape`: swept depth, where there is none what the map shows, elsewhere what lies around."""
    h, w = z.shape
    known = cv2.resize(shown, (w, h), interpolation=cv2.INTER_NEAREST)
    both = filled(np.where(z > 0.0, z, known), _FILL_PX)
    return cv2.resize(both, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST)


def _without_loners(z: np.ndarray) -> np.ndarray:
    """Drops pixels whose inverse depth differs from the median around them."""
    q = np.where(z > 0.0, 1.0 / np.maximum(z, 1e-6), 0.0).astype(np.float32)
    weight = cv2.blur((z > 0.0).astype(np.float32), (9, 9))
    mean = cv2.blur(q, (9, 9)) / np.maximum(weight, 1e-6)
    agree = (weight > 0.25) & (np.abs(q - mean) < 0.25 * mean)
    return np.where(agree, z, 0.0).astype(np.float32)
