"""Results of camera tracking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.status import TrackingStatus
from beamsplat.services.localization.camera.align import Alignment
from beamsplat.services.localization.camera.image_pyramid import ImagePyramid


@dataclass(frozen=True)
class TrackingResult:
    """Pose of the body for one image, with status and covariance."""

    stamp_ns: int
    T_map_body: np.ndarray  # float64 [4, 4]
    status: TrackingStatus
    detail: str
    covariance: np.ndarray  # float64 [3, 3] of (x, y, yaw) in the map frame, NaN unless the status is "ok"
    wants_keyframe: bool = False


@dataclass
class TrackedImage:
    """A tracked image that is stored until its depth is received: it may become a keyframe."""

    stamp_ns: int
    view: ImagePyramid
    alignment: Alignment
    covariance: np.ndarray  # float64 [3, 3] of (x, y, yaw) in the map frame


def covisibility(in_view_a: np.ndarray, in_view_b: np.ndarray) -> float:
    """Return the intersection over union of the Gaussians in two views (ascending indices int32)."""
    both = len(np.intersect1d(in_view_a, in_view_b, assume_unique=True))
    union = len(in_view_a) + len(in_view_b) - both
    return both / union if union else 0.0
