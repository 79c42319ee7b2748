"""Selection of keyframes by motion, overlap and sharpness, from pose and image alone.

An image becomes a keyframe if the camera has moved or turned far enough since the last keyframe, or if too
little of the last keyframe's view is still visible. Of the next `patience` images the sharpest is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse, is_rigid, so3_log


@dataclass(frozen=True)
class SelectionSettings:
    """Thresholds of the selection; see the module."""

    distance_m: float = 0.3
    angle_rad: float = 0.26
    least_overlap: float = 0.6  # share of the last keyframe's view that is still visible
    typical_depth_m: float = 2.5  # at which the overlap is computed
    patience: int = 3  # images considered once a keyframe is due
    blur_ratio: float = 0.5  # an image above this share of the mean sharpness is taken at once

    def __post_init__(self) -> None:
        if self.distance_m <= 0.0 or self.angle_rad <= 0.0 or not 0.0 <= self.least_overlap < 1.0:
            raise ValueError(f"distance and angle must be positive, least_overlap in [0, 1): {self}")
        if self.patience < 1 or not 0.0 <= self.blur_ratio <= 1.0:
            raise ValueError(f"patience must be at least 1, blur_ratio in [0, 1]: {self}")


@dataclass(frozen=True)
class KeyframeDecision:
    """`key` is the number of the image to use, as counted by the caller, or None; `reason` states why."""

    key: int | None
    reason: str


@dataclass
class _Candidate:
    number: int
    sharpness: float
    T_map_camera: np.ndarray
    left: int
    why: str


class KeyframeSelector:
    """Selector of keyframes in a stream of images; a decision may name the present or a recent image."""

    def __init__(self, fov_rad: tuple[float, float], settings: SelectionSettings | None = None) -> None:
        self.settings = settings or SelectionSettings()
        self._half = np.tan(0.5 * np.asarray(fov_rad, dtype=np.float64))
        self._last: np.ndarray | None = None
        self._mean_sharpness: float | None = None
        self._candidate: _Candidate | None = None

    def consider(self, number: int, grey: np.ndarray, T_map_camera: np.ndarray) -> KeyframeDecision:
        """Return the decision after one image uint8 [H, W]; call it for all images in order."""
        if not is_rigid(T_map_camera):
            return KeyframeDecision(None, "its pose is not a rigid transform")
        sharp = sharpness(grey)
        mean_sharpness = sharp if self._mean_sharpness is None else self._mean_sharpness
        self._mean_sharpness = 0.95 * mean_sharpness + 0.05 * sharp
        why = self._trigger(T_map_camera)
        if why is None and self._candidate is None:
            return KeyframeDecision(None, "too close to the last keyframe")
        if self._candidate is None or sharp > self._candidate.sharpness:
            left = self.settings.patience if self._candidate is None else self._candidate.left
            self._candidate = _Candidate(number, sharp, T_map_camera, left, why or self._candidate.why)
        self._candidate.left -= 1
        if (
            self._candidate.sharpness >= self.settings.blur_ratio * mean_sharpness
            or self._candidate.left <= 0
        ):
            return self._take()
        return KeyframeDecision(None, "blurred: waiting for a sharper image")

    def _take(self) -> KeyframeDecision:
        candidate = self._candidate
        assert candidate is not None
        self._last, self._candidate = candidate.T_map_camera, None
        return KeyframeDecision(candidate.number, candidate.why)

    def _trigger(self, T_map_camera: np.ndarray) -> str | None:
        if self._last is None:
            return "first image"
        T_last_now = inverse(self._last) @ T_map_camera
        if np.linalg.norm(T_last_now[:3, 3]) >= self.settings.distance_m:
            return "moved"
        if np.linalg.norm(so3_log(T_last_now[:3, :3])) >= self.settings.angle_rad:
            return "turned"
        if overlap(T_last_now, self._half, self.settings.typical_depth_m) < self.settings.least_overlap:
            return "little overlap"
        return None


def sharpness(grey: np.ndarray) -> float:
    """Return the variance of the Laplacian over that of the image, which is independent of contrast."""
    small = cv2.resize(grey, (320, 240), interpolation=cv2.INTER_AREA).astype(np.float32)
    return float(cv2.Laplacian(small, cv2.CV_32F).var() / (small.var() + 25.0))


def overlap(T_last_now: np.ndarray, half_slopes: np.ndarray, depth_m: float, grid: int = 9) -> float:
    """Return the share of the last view, a plane at `depth_m`, that is inside the present view."""
    slopes = np.linspace(-1.0, 1.0, grid)
    x, y = np.meshgrid(slopes * half_slopes[0], slopes * half_slopes[1])
    points = np.stack([x.ravel(), y.ravel(), np.ones(grid * grid)], axis=1) * depth_m
    T_now_last = inverse(T_last_now)
    now = points @ T_now_last[:3, :3].T + T_now_last[:3, 3]
    ahead = now[:, 2] > 0.05
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = ahead & np.all(np.abs(now[:, :2] / now[:, 2:3]) <= half_slopes + 1e-9, axis=1)
    return float(inside.mean())
