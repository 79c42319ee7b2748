"""A picture as the tracker wants it: small, grey, in a pyramid; and whether it shows anything."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.raster.camera import RasterCamera

GREY = np.array([0.299, 0.587, 0.114], np.float32)  # of red, green, blue


@dataclass(frozen=True)
class GreyLevel:
    """One size of a picture."""

    grey: np.ndarray  # float32 [H, W] in [0, 1]
    slope_x: np.ndarray  # float32 [H, W], central differences a pixel
    slope_y: np.ndarray


@dataclass(frozen=True)
class PictureView:
    """A picture at the tracker's size: finest level first."""

    rgb: np.ndarray  # uint8 [h, w, 3] at the finest level
    levels: tuple[GreyLevel, ...]

    @property
    def contrast(self) -> float:
        """Standard deviation of the grey at the finest level."""
        return float(self.levels[0].grey.std())


def small_camera(camera: Pinhole, width_px: int) -> RasterCamera:
    """The finest level's camera: `width_px` wide, or the picture's own size where that is smaller; even."""
    full = RasterCamera(
        camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px
    )
    width = min(width_px, camera.width_px) // 8 * 8
    height = max(round(camera.height_px * width / camera.width_px / 8) * 8, 8)
    return full.resized(width, height)


def make_view(rgb: np.ndarray, camera: RasterCamera, levels: int) -> PictureView:
    """Pyramid of a picture uint8 [H, W, 3].

    Raises:
        ValueError: it is no such picture.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise ValueError(f"the picture must be uint8 [H, W, 3], got {rgb.dtype} {list(rgb.shape)}")
    small = cv2.resize(rgb, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)
    grey = (small.astype(np.float32) @ GREY) * np.float32(1 / 255)
    pyramid = []
    for level in range(levels):
        if level:
            grey = halved(grey)
        pyramid.append(GreyLevel(grey, *slopes(grey)))
    return PictureView(small, tuple(pyramid))


def halved(array: np.ndarray) -> np.ndarray:
    """Mean of 2 x 2 blocks of float32 [H, W] (even sizes)."""
    return cv2.resize(array, (array.shape[1] // 2, array.shape[0] // 2), interpolation=cv2.INTER_AREA)


def slopes(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Central differences a pixel, along x and along y, float32 [H, W] each."""
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32)
    return (
        cv2.filter2D(grey, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE),
        cv2.filter2D(grey, cv2.CV_32F, kernel.T.copy(), borderType=cv2.BORDER_REPLICATE),
    )
