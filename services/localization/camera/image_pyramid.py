"""Grey image pyramids for tracking."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.raster.camera import RasterCamera

GREY = np.array([0.299, 0.587, 0.114], np.float32)  # of red, green, blue


@dataclass(frozen=True)
class GreyLevel:
    """Grey values and image gradients of one pyramid level."""

    grey: np.ndarray  # float32 [H, W] in [0, 1]
    gradient_x: np.ndarray  # float32 [H, W], central differences per pixel
    gradient_y: np.ndarray


@dataclass(frozen=True)
class ImagePyramid:
    """An image at the tracker's resolution; levels from fine to coarse, each with half the size."""

    rgb: np.ndarray  # uint8 [h, w, 3] at the finest level
    levels: tuple[GreyLevel, ...]

    @property
    def contrast(self) -> float:
        """Return the standard deviation of the grey values at the finest level."""
        return float(self.levels[0].grey.std())


def tracking_camera(camera: Pinhole, width_px: int) -> RasterCamera:
    """Scale a camera to the finest level: at most `width_px` wide, both sides multiples of 8 pixels."""
    full = RasterCamera(
        camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px
    )
    width = min(width_px, camera.width_px) // 8 * 8
    height = max(round(camera.height_px * width / camera.width_px / 8) * 8, 8)
    return full.resized(width, height)


def make_image_pyramid(rgb: np.ndarray, camera: RasterCamera, levels: int) -> ImagePyramid:
    """Return the pyramid of an RGB image uint8 [H, W, 3]; `camera` has the size of the finest level.

    Raises:
        ValueError: the array has another shape or type.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise ValueError(f"the image must be uint8 [H, W, 3], got {rgb.dtype} {list(rgb.shape)}")
    small = cv2.resize(rgb, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)
    grey = (small.astype(np.float32) @ GREY) * np.float32(1 / 255)
    pyramid = []
    for level in range(levels):
        if level:
            grey = downsample_2x(grey)
        pyramid.append(GreyLevel(grey, *image_gradients(grey)))
    return ImagePyramid(small, tuple(pyramid))


def downsample_2x(array: np.ndarray) -> np.ndarray:
    """Return the means of all 2 x 2 blocks: float32 [H / 2, W / 2] from [H, W], both sides even."""
    return cv2.resize(array, (array.shape[1] // 2, array.shape[0] // 2), interpolation=cv2.INTER_AREA)


def image_gradients(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the central differences per pixel along x and y, float32 [H, W] each."""
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32)
    return (
        cv2.filter2D(grey, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE),
        cv2.filter2D(grey, cv2.CV_32F, kernel.T.copy(), borderType=cv2.BORDER_REPLICATE),
    )
