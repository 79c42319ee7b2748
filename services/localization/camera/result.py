"""What tracking says about a picture, and what it keeps of one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.camera.align import Alignment
from beamsplat.services.localization.camera.view import PictureView


@dataclass(frozen=True)
class CameraResult:
    """What is said about one picture."""

    stamp_ns: int
    T_map_body: np.ndarray
    status: str  # "ok", "lost", "relocalizing", "rejected"
    detail: str
    covariance: np.ndarray  # float64 [3, 3] of (x, y, yaw), NaN unless ok
    wants_keyframe: bool = False


@dataclass
class Tracked:
    """A picture that has a pose; its depth may still come."""

    stamp_ns: int
    view: PictureView
    alignment: Alignment
    covariance: np.ndarray


def covisibility(in_view_a: np.ndarray, in_view_b: np.ndarray) -> float:
    """Intersection over union of two ascending lists of Gaussians."""
    both = len(np.intersect1d(in_view_a, in_view_b, assume_unique=True))
    union = len(in_view_a) + len(in_view_b) - both
    return both / union if union else 0.0
