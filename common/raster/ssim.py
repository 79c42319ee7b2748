"""SSIM (Wang et al. 2004): a loss on luma with its gradient, and a metric on RGB.

The window is an 11 x 11 Gaussian with sigma 1.5 px, the image is zero-padded, as in 3DGS.
"""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.compiled import inner, kernel
from beamsplat.common.raster.simd_memory import atomic_next
from beamsplat.common.raster.threads import ThreadTeam

C1, C2 = 0.01**2, 0.03**2  # Wang et al. 2004, for values in [0, 1]
_RADIUS = 5  # px
_TAPS = np.exp(-0.5 * (np.arange(-_RADIUS, _RADIUS + 1) / 1.5) ** 2)
TAPS = (_TAPS / _TAPS.sum()).astype(np.float32)
LUMA = (np.float32(0.299), np.float32(0.587), np.float32(0.114))  # weights of R, G, B: ITU-R BT.601
_BAND = 16  # rows per unit of work of a thread
_PAD = 8  # zeros at both ends of a row, at least _RADIUS


@inner
def _blur_columns(source: np.ndarray, y: int, out: np.ndarray, taps: np.ndarray) -> None:
    """Blur `source` along its columns at row y (zero outside), into out[_PAD + x]."""
    height, width = source.shape
    for x in range(width):
        out[_PAD + x] = np.float32(0.0)
    for k in range(max(0, _RADIUS - y), min(2 * _RADIUS + 1, height + _RADIUS - y)):
        tap, row = taps[k], source[y + k - _RADIUS]
        for x in range(width):
            out[_PAD + x] += tap * row[x]


@inner
def _blur_along_row(padded: np.ndarray, out: np.ndarray, taps: np.ndarray) -> None:
    """Blur `padded`, a row with `_PAD` zeros at both ends, into out[x]."""
    for x in range(len(out)):
        out[x] = np.float32(0.0)
    for k in range(2 * _RADIUS + 1):
        tap = taps[k]
        for x in range(len(out)):
            out[x] += tap * padded[_PAD - _RADIUS + k + x]


@kernel
def _prepare(
    counter: np.ndarray, image: np.ndarray, rgb: np.ndarray, luma: np.ndarray, planes: np.ndarray
) -> None:
    """Fill the planes x, y, xx, yy, xy; x, y = luma of the rendered and the true image (`rgb`, 0 to 255).

    `luma` float32 [4]: weights of red, green and blue of the rendered image, and an offset.
    """
    height = image.shape[1]
    unit = np.float32(1.0 / 255.0)
    while True:
        y = atomic_next(counter, 0)
        if y >= height:
            return
        for x in range(image.shape[2]):
            a = luma[0] * image[0, y, x] + luma[1] * image[1, y, x] + luma[2] * image[2, y, x] + luma[3]
            b = unit * (LUMA[0] * rgb[0, y, x] + LUMA[1] * rgb[1, y, x] + LUMA[2] * rgb[2, y, x])
            planes[0, y, x], planes[1, y, x] = a, b
            planes[2, y, x], planes[3, y, x], planes[4, y, x] = a * a, b * b, a * b


@kernel
def _partials(
    counter: np.ndarray, planes: np.ndarray, taps: np.ndarray, partials: np.ndarray, sums: np.ndarray
) -> None:
    """Compute dSSIM/d(mean x, mean xx, mean xy) at each pixel, and the sum of SSIM over each row."""
    height, width = planes.shape[1], planes.shape[2]
    padded = np.zeros(width + 2 * _PAD, np.float32)
    m = np.empty((5, width), np.float32)
    while True:
        band = atomic_next(counter, 0) * _BAND
        if band >= height:
            return
        for y in range(band, min(height, band + _BAND)):
            for p in range(5):
                _blur_columns(planes[p], y, padded, taps)
                _blur_along_row(padded, m[p], taps)
            total = np.float32(0.0)
            for x in range(width):
                mx, my = m[0, x], m[1, x]
                a1, a2 = (
                    np.float32(2.0) * mx * my + np.float32(C1),
                    np.float32(2.0) * (m[4, x] - mx * my) + np.float32(C2),
                )
                b1 = mx * mx + my * my + np.float32(C1)
                b2 = m[2, x] - mx * mx + m[3, x] - my * my + np.float32(C2)
                inverse = np.float32(1.0) / (b1 * b2)
                s = a1 * a2 * inverse
                d_xy, d_xx = np.float32(2.0) * a1 * inverse, -s / b2
                partials[0, y, x] = (
                    np.float32(2.0) * my * a2 * inverse
                    - np.float32(2.0) * mx * s / b1
                    - my * d_xy
                    - np.float32(2.0) * mx * d_xx
                )
                partials[1, y, x], partials[2, y, x] = d_xx, d_xy
                total += s
            sums[y] = total


@kernel
def _accumulate_gradient(
    counter: np.ndarray,
    planes: np.ndarray,
    partials: np.ndarray,
    taps: np.ndarray,
    scale: np.float32,
    luma: np.ndarray,
    gradient: np.ndarray,
) -> None:
    """Add scale * dSSIM/d(pixel) to the rows R, G, B of `gradient`; `luma` as in `_prepare`."""
    height, width = planes.shape[1], planes.shape[2]
    padded = np.zeros(width + 2 * _PAD, np.float32)
    m = np.empty((3, width), np.float32)
    while True:
        band = atomic_next(counter, 0) * _BAND
        if band >= height:
            return
        for y in range(band, min(height, band + _BAND)):
            for p in range(3):
                _blur_columns(partials[p], y, padded, taps)
                _blur_along_row(padded, m[p], taps)
            for x in range(width):
                g = m[0, x] + np.float32(2.0) * planes[0, y, x] * m[1, x] + planes[1, y, x] * m[2, x]
                g *= scale
                gradient[0, y, x] += luma[0] * g
                gradient[1, y, x] += luma[1] * g
                gradient[2, y, x] += luma[2] * g


class SsimLoss:
    """The loss weight * (1 - SSIM) / 2 on luma, with its gradient; buffers are reused per image size."""

    def __init__(self) -> None:
        self._memory: dict[tuple[int, int], tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    @property
    def allocated_bytes(self) -> int:
        return sum(array.nbytes for arrays in self._memory.values() for array in arrays)

    def add(
        self,
        image: np.ndarray,
        rgb: np.ndarray,
        exposure: np.ndarray,
        weight: float,
        gradient: np.ndarray,
        team: ThreadTeam,
    ) -> float:
        """Add dL/d(image) to `gradient`, and return the loss L.

        Args:
            image: rendered image, float32 [5, H, W]: red, green, blue in [0, 1], depth, alpha (not used).
            rgb: camera image to compare with, [3, H, W]: red, green, blue, 0 to 255.
            exposure: float32 [6], log gains of red, green, blue, then their offsets (not log). The rendered
                colour is compared after exp(log gain) * colour + offset.
            weight: weight of the loss.
            gradient: float32 [5, H, W], channels as in `image`; changed in place.
            team: threads that run the kernels.
        """
        h, w = image.shape[1:]
        if (h, w) not in self._memory:
            self._memory[h, w] = np.empty((5, h, w), np.float32), np.empty((3, h, w), np.float32), np.empty(h)
        planes, partials, sums = self._memory[h, w]
        weights = np.array(LUMA)
        luma = np.append(weights * np.exp(exposure[:3]), weights @ exposure[3:]).astype(np.float32)
        team.run(_prepare, image, rgb, luma, planes)
        team.run(_partials, planes, TAPS, partials, sums)
        scale = np.float32(-0.5 * weight / (h * w))
        team.run(_accumulate_gradient, planes, partials, TAPS, scale, luma, gradient)
        return 0.5 * weight * (1.0 - float(sums.sum()) / (h * w))


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Return the SSIM of two images, float32 [H, W, C] in [0, 1]: the mean over pixels and channels."""

    def blur(x: np.ndarray) -> np.ndarray:
        taps = TAPS.astype(np.float64)
        return cv2.sepFilter2D(x.astype(np.float64), cv2.CV_64F, taps, taps, borderType=cv2.BORDER_CONSTANT)

    mx, my = blur(a), blur(b)
    xx, yy, xy = blur(a * a) - mx * mx, blur(b * b) - my * my, blur(a * b) - mx * my
    return float(np.mean((2 * mx * my + C1) * (2 * xy + C2) / ((mx**2 + my**2 + C1) * (xx + yy + C2))))
