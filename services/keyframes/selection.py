"""Keyframes by motion, overlap and sharpness, decided on the robot from pose and picture alone.

A picture becomes a keyframe when the camera has moved or turned far enough since the last one, or when too
little of what the last one saw is still in view. Of the pictures around that moment the sharpest is taken:
the choice waits for at most `patience` pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse, is_rigid, so3_log


@dataclass(frozen=True)
class SelectionSettings:
    """See module."""

    distance_m: float = 0.3
    angle_rad: float = 0.26
    least_overlap: float = 0.6  # share of the last keyframe's view that is still seen
    typical_depth_m: float = 2.5  # at which overlap is judged
    patience: int = 3  # pictures looked at once one is due
    blur_ratio: float = 0.5  # sharper than this share of the usual: taken at once

    def __post_init__(self) -> None:
        if self.distance_m <= 0.0 or self.angle_rad <= 0.0 or not 0.0 <= self.least_overlap < 1.0:
            raise ValueError(f"distance and angle must be positive, least_overlap in [0, 1): {self}")
        if self.patience < 1 or not 0.0 <= self.blur_ratio <= 1.0:
            raise ValueError(f"patience must be at least 1, blur_ratio in [0, 1]: {self}")


@dataclass(frozen=True)
class Decision:
    """`key` is the number (as counted by the caller) of a picture to use, or None; `reason` says why."""

    key: int | None
    reason: str


@dataclass
class _Waiting:
    number: int
    sharpness: float
    T_map_camera: np.ndarray
    left: int
    why: str


class KeyframeSelector:
    """Feed every picture with its pose in order; each call may name a picture, this one or a recent one."""

    def __init__(self, fov_rad: tuple[float, float], settings: SelectionSettings | None = None) -> None:
        self.settings = settings or SelectionSettings()
        self._half = np.tan(0.5 * np.asarray(fov_rad, dtype=np.float64))
        self._last: np.ndarray | None = None
        self._usual: float | None = None
        self._waiting: _Waiting | None = None

    def consider(self, number: int, grey: np.ndarray, T_map_camera: np.ndarray) -> Decision:
        """Decides on one picture (uint8 [H, W])."""
        if not is_rigid(T_map_camera):
            return Decision(None, "its pose is not a rigid transform")
        sharp = sharpness(grey)
        usual = sharp if self._usual is None else self._usual
        self._usual = 0.95 * usual + 0.05 * sharp
        why = self._due(T_map_camera)
        if why is None and self._waiting is None:
            return Decision(None, "too near to the last keyframe")
        if self._waiting is None or sharp > self._waiting.sharpness:
            left = self.settings.patience if self._waiting is None else self._waiting.left
            self._waiting = _Waiting(number, sharp, T_map_camera, left, why or self._waiting.why)
        self._waiting.left -= 1
        if self._waiting.sharpness >= self.settings.blur_ratio * usual or self._waiting.left <= 0:
            return self._take()
        return Decision(None, "blurred; waits for a sharper picture")

    def _take(self) -> Decision:
        waiting = self._waiting
        assert waiting is not None
        self._last, self._waiting = waiting.T_map_camera, None
        return Decision(waiting.number, waiting.why)

    def _due(self, T_map_camera: np.ndarray) -> str | None:
        if self._last is None:
            return "first picture"
        T_last_now = inverse(self._last) @ T_map_camera
        if np.linalg.norm(T_last_now[:3, 3]) >= self.settings.distance_m:
            return "moved"
        if np.linalg.norm(so3_log(T_last_now[:3, :3])) >= self.settings.angle_rad:
            return "turned"
        if overlap(T_last_now, self._half, self.settings.typical_depth_m) < self.settings.least_overlap:
            return "little overlap"
        return None


def sharpness(grey: np.ndarray) -> float:
    """Variance of the Laplacian over that of the picture: contrast alone does not count."""
    small = cv2.resize(grey, (320, 240), interpolation=cv2.INTER_AREA).astype(np.float32)
    return float(cv2.Laplacian(small, cv2.CV_32F).var() / (small.var() + 25.0))


def overlap(T_last_now: np.ndarray, half_slopes: np.ndarray, depth_m: float, grid: int = 9) -> float:
    """Share of the last view, as a plane at `depth_m`, that lies inside the view of now."""
    slopes = np.linspace(-1.0, 1.0, grid)
    x, y = np.meshgrid(slopes * half_slopes[0], slopes * half_slopes[1])
    points = np.stack([x.ravel(), y.ravel(), np.ones(grid * grid)], axis=1) * depth_m
    T_now_last = inverse(T_last_now)
    now = points @ T_now_last[:3, :3].T + T_now_last[:3, 3]
    ahead = now[:, 2] > 0.05
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = ahead & np.all(np.abs(now[:, :2] / now[:, 2:3]) <= half_slopes + 1e-9, axis=1)
    return float(inside.mean())
