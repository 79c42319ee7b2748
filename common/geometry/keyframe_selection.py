"""Selection of keyframes by motion, overlap and sharpness, from pose and image alone.

An image becomes a keyframe if the camera has moved or turned far enough since the last keyframe, or if too
little of the last keyframe's view is still visible. A blurred image is passed over, but at most `patience`
images in a row.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import inverse, is_rigid, so3_log


@dataclass(frozen=True)
class SelectionSettings:
    """Thresholds of the keyframe selection; the module describes the rule."""

    distance_m: float = 0.3
    angle_rad: float = 0.26
    least_overlap: float = 0.6  # share of the last keyframe's view that is still visible
    typical_depth_m: float = 2.5  # at which the overlap is computed
    patience: int = 2  # the image of this number after a keyframe is due is taken even if it is blurred
    blur_ratio: float = 0.5  # an image below this share of the mean sharpness is blurred

    def __post_init__(self) -> None:
        if self.distance_m <= 0.0 or self.angle_rad <= 0.0 or not 0.0 <= self.least_overlap < 1.0:
            raise ValueError(f"distance and angle must be positive, least_overlap in [0, 1): {self}")
        if self.patience < 1 or not 0.0 <= self.blur_ratio <= 1.0:
            raise ValueError(f"patience must be at least 1, blur_ratio in [0, 1]: {self}")


@dataclass(frozen=True)
class Selection:
    """The decision on one image: whether it becomes a keyframe, and the reason in words."""

    selected: bool
    reason: str


class KeyframeSelector:
    """Decides for each candidate image in turn whether it becomes a keyframe."""

    def __init__(self, fov_rad: tuple[float, float], settings: SelectionSettings | None = None) -> None:
        """`fov_rad`: horizontal and vertical field of view of the camera (see `field_of_view`)."""
        self.settings = settings or SelectionSettings()
        self._half = np.tan(0.5 * np.asarray(fov_rad, dtype=np.float64))
        self._last: np.ndarray | None = None  # T_map_camera of the last keyframe
        self._before_last: np.ndarray | None = None
        self._mean_sharpness: float | None = None
        self._blurred = 0  # candidates passed over since a keyframe was due

    def decide(self, T_map_camera: np.ndarray, sharpness: float) -> Selection:
        """Decide whether one candidate image becomes a keyframe, and store its pose if so.

        Args:
            T_map_camera: pose of the camera, [4, 4].
            sharpness: result of the function `sharpness` for the image.
        """
        if not is_rigid(T_map_camera):
            return Selection(False, "its pose is not a rigid transform")
        mean = sharpness if self._mean_sharpness is None else self._mean_sharpness
        self._mean_sharpness = 0.95 * mean + 0.05 * sharpness
        reason = self._trigger(T_map_camera)
        if reason is None:
            self._blurred = 0
            return Selection(False, "too close to the last keyframe")
        if sharpness < self.settings.blur_ratio * mean and self._blurred + 1 < self.settings.patience:
            self._blurred += 1
            return Selection(False, "blurred: waiting for a sharper image")
        self._blurred = 0
        self._before_last, self._last = self._last, T_map_camera
        return Selection(True, reason)

    def withdraw(self, T_map_camera: np.ndarray) -> None:
        """Undo the selection of the image taken at this pose: it has no depth, so it is no keyframe.

        No effect if another image was selected since: then that one takes its place.
        """
        if self._last is not None and np.array_equal(self._last, T_map_camera):
            self._last = self._before_last

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


def field_of_view(camera: Pinhole) -> tuple[float, float]:
    """Return the horizontal and vertical field of view in rad, without distortion."""
    half = np.arctan([0.5 * camera.width_px / camera.fx_px, 0.5 * camera.height_px / camera.fy_px])
    return 2.0 * float(half[0]), 2.0 * float(half[1])


def sharpness(
    grey: np.ndarray,  # uint8 [H, W]
) -> float:
    """Return the sharpness of an image: variance of its Laplacian divided by the variance of its brightness.

    The division makes the value independent of the contrast. Without unit; larger is sharper.
    """
    small = cv2.resize(grey, (320, 240), interpolation=cv2.INTER_AREA).astype(np.float32)
    return float(cv2.Laplacian(small, cv2.CV_32F).var() / (small.var() + 25.0))


def overlap(T_last_now: np.ndarray, half_slopes: np.ndarray, depth_m: float, grid: int = 9) -> float:
    """Return the fraction (0 to 1) of the last keyframe's view that is inside the present view.

    The scene is approximated by a plane at optical z = `depth_m` in front of the last keyframe.

    Args:
        T_last_now: present camera pose in the camera frame of the last keyframe, [4, 4].
        half_slopes: tangents of half the horizontal and vertical field of view, [2].
        depth_m: optical z of the plane.
        grid: number of sample points along each side of the view.
    """
    slopes = np.linspace(-1.0, 1.0, grid)
    x, y = np.meshgrid(slopes * half_slopes[0], slopes * half_slopes[1])
    points = np.stack([x.ravel(), y.ravel(), np.ones(grid * grid)], axis=1) * depth_m
    T_now_last = inverse(T_last_now)
    now = points @ T_now_last[:3, :3].T + T_now_last[:3, 3]
    ahead = now[:, 2] > 0.05
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = ahead & np.all(np.abs(now[:, :2] / now[:, 2:3]) <= half_slopes + 1e-9, axis=1)
    return float(inside.mean())
