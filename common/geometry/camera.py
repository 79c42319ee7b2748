"""Pinhole camera model: projection, rays, undistortion, and scaling of K to another image size.

Pixel centres have integer coordinates: the image covers [-0.5, width - 0.5] x [-0.5, height - 0.5].
Images are undistorted once, after decoding; all later stages use the camera `Pinhole.undistorted`.
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
    """Camera intrinsics at one image size: focal lengths, principal point, distortion (OpenCV coefficients).

    Raises:
        ValueError: a focal length or the size is not positive, or the distortion model is unknown.
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
                f"distortion model {self.distortion_model!r} is unknown; the models are {', '.join(MODELS)}"
            )

    @classmethod
    def of(cls, camera: CameraModel) -> Pinhole:
        """Return the intrinsics and distortion in `camera`, which is part of a message."""
        return cls(
            camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px,
            camera.distortion_model, tuple(camera.distortion),
        )  # fmt: skip

    @property
    def K(self) -> np.ndarray:
        """Camera matrix, float64 [3, 3]."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.height_px, self.width_px

    @property
    def is_distorted(self) -> bool:
        return self.distortion_model != "none" and any(self.distortion)

    def resized(self, width_px: int, height_px: int) -> Pinhole:
        """Return the same camera for an image resampled to another size.

        The edges of the image area stay fixed; because pixel centres are integers, cx and cy are scaled about
        the corner at (-0.5, -0.5).
        """
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
        """Return the camera of undistorted images (results of `Undistorter`): the same K, no distortion."""
        return replace(self, distortion_model="none", distortion=())

    def project(self, points_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points [N, 3] (m, camera frame).

        Returns:
            Pixels (u, v) float64 [N, 2], NaN for points behind the camera; and a mask bool [N] of the points
            in front of the camera and inside the image.

        A strong radial polynomial is not monotonic and can map points far outside the field of view into the
        image. The mask excludes these: the ray of their pixel (`rays`) differs from the point's direction.
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
        """Return a mask bool [N] of the pixels [N, 2] that are inside the image."""
        u, v = uv_px[..., 0], uv_px[..., 1]
        return (u >= -0.5) & (u < self.width_px - 0.5) & (v >= -0.5) & (v < self.height_px - 0.5)

    def rays(self, uv_px: np.ndarray) -> np.ndarray:
        """Return the undistorted rays float64 [N, 3] with z = 1 through pixels [N, 2]."""
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
        """Return the undistorted rays float64 [H, W, 3] with z = 1 through all pixel centres."""
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


_BAND_ROWS = 32  # of the image, for which the remap tables are computed at a time


class Undistorter:
    """Image undistortion for one camera; the remap tables are computed once, in the constructor."""

    def __init__(self, camera: Pinhole) -> None:
        self.camera = camera
        self.pinhole = camera.undistorted()
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        if camera.is_distorted:
            h, w = camera.shape
            uv = np.empty((h, w, 2), np.float32)
            # In bands: OpenCV needs 300 bytes per point, 5 GB for an image of 16 million pixels.
            for first in range(0, h, _BAND_ROWS):
                v, u = np.mgrid[first : min(first + _BAND_ROWS, h), :w].astype(np.float64)
                rays = self.pinhole.rays(np.stack([u.ravel(), v.ravel()], axis=1))
                uv[first : first + _BAND_ROWS] = camera._distort(rays[:, :2]).reshape(-1, w, 2)
            # The stubs do not know that map2 may be None.
            self._maps = cv2.convertMaps(uv, None, cv2.CV_16SC2)  # type: ignore[call-overload]

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the undistorted image, uint8 [H, W] or [H, W, 3]; pixels outside the original are black.

        Raises:
            ValueError: the image does not have the camera's size.
        """
        if image.shape[:2] != self.camera.shape:
            raise ValueError(f"image is {image.shape[1]}x{image.shape[0]}, K belongs to "
                             f"{self.camera.width_px}x{self.camera.height_px}")  # fmt: skip
        if self._maps is None:
            return image
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR)
