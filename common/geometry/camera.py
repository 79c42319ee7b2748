"""Pinhole cameras: projection, rays, undistortion, and K at another image size.

Pixel centres have integer coordinates: the image covers [-0.5, width - 0.5] x [-0.5, height - 0.5].
Undistortion happens once, where an image is opened; everything behind sees `Pinhole.undistorted`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from beamsplat.common.messages.sensor_models import CameraModel

MODELS = ("none", "plumb_bob", "rational_polynomial", "equidistant")


@dataclass(frozen=True)
class Pinhole:
    """K of one image size, and the lens distortion in front of it (OpenCV's coefficients).

    Raises:
        ValueError: K does not belong to the size, or the distortion model is unknown.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int
    distortion_model: str = "none"
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.fx_px <= 0.0 or self.fy_px <= 0.0 or self.width_px <= 0 or self.height_px <= 0:
            raise ValueError(f"focal lengths and image size must be positive: {self}")
        if self.distortion_model not in MODELS:
            raise ValueError(
                f"distortion model {self.distortion_model!r} is unknown; there are {', '.join(MODELS)}"
            )

    @classmethod
    def of(cls, camera: CameraModel) -> Pinhole:
        """Of the camera in a message."""
        return cls(
            camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px,
            camera.distortion_model, tuple(camera.distortion),
        )  # fmt: skip

    @property
    def K(self) -> np.ndarray:
        """float64 [3, 3]."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.height_px, self.width_px

    @property
    def is_distorted(self) -> bool:
        return self.distortion_model != "none" and any(self.distortion)

    def resized(self, width_px: int, height_px: int) -> Pinhole:
        """The same view sampled at another size; area edges stay, so centres shift by half pixels."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return replace(
            self,
            fx_px=self.fx_px * sx,
            fy_px=self.fy_px * sy,
            cx_px=(self.cx_px + 0.5) * sx - 0.5,
            cy_px=(self.cy_px + 0.5) * sy - 0.5,
            width_px=width_px,
            height_px=height_px,
        )

    def undistorted(self) -> Pinhole:
        """The ideal pinhole with the same K that `Undistorter` renders into."""
        return replace(self, distortion_model="none", distortion=())

    def project(self, points_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (u, v) float64 [N, 2] of points [N, 3], and bool [N]: in front and inside the image.

        Where the flag is False because the point lies behind the camera, (u, v) is NaN. Strong radial
        polynomials fold back far outside the image; such points are flagged False by comparing the ray
        with what `rays` gives back.
        """
        points = np.asarray(points_camera, dtype=np.float64).reshape(-1, 3)
        front = points[:, 2] > 1e-6
        uv = np.full((len(points), 2), np.nan)
        normalized = points[front, :2] / points[front, 2:3]
        uv[front] = self._distort(normalized)
        inside = front.copy()
        inside[front] &= self.contains(uv[front])
        if self.is_distorted and inside.any():
            back = self.rays(uv[inside])[:, :2]
            true = points[inside, :2] / points[inside, 2:3]
            inside[inside] = np.abs(back - true).max(axis=1) < 0.02 * (1.0 + np.abs(true).max(axis=1))
        return uv, inside

    def contains(self, uv_px: np.ndarray) -> np.ndarray:
        """bool [N]: whether pixels [N, 2] lie inside the image."""
        u, v = uv_px[..., 0], uv_px[..., 1]
        return (u >= -0.5) & (u < self.width_px - 0.5) & (v >= -0.5) & (v < self.height_px - 0.5)

    def rays(self, uv_px: np.ndarray) -> np.ndarray:
        """Rays float64 [N, 3] with z = 1 through pixels [N, 2], the lens undone."""
        uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
        out = np.ones((len(uv), 3))
        if len(uv) == 0:
            return out
        if not self.is_distorted:
            out[:, 0] = (uv[:, 0] - self.cx_px) / self.fx_px
            out[:, 1] = (uv[:, 1] - self.cy_px) / self.fy_px
        elif self.distortion_model == "equidistant":
            d = np.array(self.distortion)
            out[:, :2] = cv2.fisheye.undistortPoints(uv[:, None], self.K, d)[:, 0]
        else:
            criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-12)
            d = np.array(self.distortion)
            out[:, :2] = cv2.undistortPoints(uv[:, None], self.K, d, None, None, None, criteria)[:, 0]
        return out

    def ray_grid(self) -> np.ndarray:
        """Rays float64 [H, W, 3] with z = 1 through all pixel centres."""
        v, u = np.mgrid[: self.height_px, : self.width_px].astype(np.float64)
        return self.rays(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(self.height_px, self.width_px, 3)

    def _distort(self, xy: np.ndarray) -> np.ndarray:
        if len(xy) == 0:
            return np.zeros((0, 2))
        if not self.is_distorted:
            return xy * [self.fx_px, self.fy_px] + [self.cx_px, self.cy_px]
        rays = np.column_stack([xy, np.ones(len(xy))])[:, None]
        zero, d = np.zeros(3), np.array(self.distortion)
        if self.distortion_model == "equidistant":
            return cv2.fisheye.projectPoints(rays, zero, zero, self.K, d)[0].reshape(-1, 2)
        return cv2.projectPoints(rays, zero, zero, self.K, d)[0].reshape(-1, 2)


class Undistorter:
    """Renders images of a distorted camera as its ideal pinhole sees them. Maps are made once."""

    def __init__(self, camera: Pinhole) -> None:
        self.camera = camera
        self.pinhole = camera.undistorted()
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        if camera.is_distorted:
            rays = self.pinhole.ray_grid().reshape(-1, 3)
            uv = camera._distort(rays[:, :2]).astype(np.float32).reshape(*camera.shape, 2)
            self._maps = cv2.convertMaps(uv, None, cv2.CV_16SC2)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """uint8 [H, W] or [H, W, 3] of the camera to the same of the pinhole; outside is black.

        Raises:
            ValueError: the image is not of the camera's size.
        """
        if image.shape[:2] != self.camera.shape:
            raise ValueError(f"image is {image.shape[1]}x{image.shape[0]}, K belongs to "
                             f"{self.camera.width_px}x{self.camera.height_px}")  # fmt: skip
        if self._maps is None:
            return image
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR)
