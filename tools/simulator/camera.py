"""The camera: rays of its pixels, with plumb_bob distortion, and the image formation of its sensor.

Normalised image coordinates are (x / z, y / z) in the camera frame. Exposed light is radiance times the
exposure gain; 1 is a fully exposed pixel.
"""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.tools.simulator.atlas import linear_to_srgb

WHITE = 4096  # entries of the tone table per unit of exposed light
SHOT_NOISE = 0.0009  # shot noise variance of a fully exposed pixel: about 1100 photoelectrons
READ_NOISE = 4e-6  # read noise variance, in squared units of exposed light


def distort(points: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """Return the distorted normalised image coordinates [N, 2] of undistorted ones, `points` [N, 2].

    The distortion model is plumb_bob with the coefficients (k1, k2, p1, p2, k3), as in OpenCV.
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = points[:, 0], points[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def undistort(points: np.ndarray, distortion: tuple[float, ...], iterations: int = 30) -> np.ndarray:
    """Return the undistorted normalised image coordinates [N, 2] of distorted ones, `points` [N, 2].

    This is the inverse of `distort`, computed by Newton's method with a numeric Jacobian.

    Raises:
        ValueError: the distortion folds over inside the image, so some pixels have no ray.
    """
    ideal, step = points.copy(), 1e-6
    right, down = np.array([step, 0.0]), np.array([0.0, step])
    for _ in range(iterations):
        error = distort(ideal, distortion) - points
        fx = (distort(ideal + right, distortion) - distort(ideal - right, distortion)) / (2 * step)
        fy = (distort(ideal + down, distortion) - distort(ideal - down, distortion)) / (2 * step)
        det = fx[:, 0] * fy[:, 1] - fy[:, 0] * fx[:, 1]
        if np.any(det < 0.05):
            break
        dx = (fy[:, 1] * error[:, 0] - fy[:, 0] * error[:, 1]) / det
        dy = (fx[:, 0] * error[:, 1] - fx[:, 1] * error[:, 0]) / det
        ideal = ideal - np.stack([dx, dy], axis=-1)
        if np.abs(error).max() < 1e-12:
            return ideal
    if np.abs(distort(ideal, distortion) - points).max() > 1e-9:
        raise ValueError(
            f"distortion {distortion} folds over inside the image: "
            "use smaller coefficients or a longer focal length"
        )
    return ideal


def pixel_rays(
    width: int, height: int, K: np.ndarray, distortion: tuple[float, ...] = (0.0,) * 5
) -> np.ndarray:
    """Return the ray of each pixel in the camera frame, float64 [H, W, 3] with z = 1.

    Pixel centres are at integer coordinates; `K` is the intrinsic matrix [3, 3] in pixels.
    """
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    points = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1).reshape(-1, 2)
    if any(distortion):
        points = undistort(points, distortion)
    return np.concatenate([points, np.ones((len(points), 1))], axis=1).reshape(height, width, 3)


def _tone_table() -> np.ndarray:
    """Return the sRGB values 0..255 of exposed light 0..4, float32 [4 * WHITE + 1].

    The tone curve is linear up to 0.7 and has a soft shoulder above.
    """
    x = np.arange(4 * WHITE + 1) / WHITE
    knee = 0.7
    soft = knee + (1 - knee) * (1 - np.exp(-(x - knee) / (1 - knee)))
    return (255.0 * linear_to_srgb(np.where(x < knee, x, soft))).astype(np.float32)


TONE = _tone_table()


@kernel
def _develop(
    radiance: np.ndarray,
    gain: float,
    falloff: np.ndarray,
    noise: np.ndarray,
    tone: np.ndarray,
    shot: float,
    read: float,
    out: np.ndarray,
) -> None:
    height, width = radiance.shape[:2]
    top = len(tone) - 1
    for y in range(height):
        for x in range(width):
            for c in range(3):
                value = radiance[y, x, c] * gain * falloff[y, x]
                value += noise[y, x, c] * np.sqrt(shot * max(value, 0.0) + read)
                at = int(min(max(value, 0.0) * WHITE + 0.5, float(top)))
                out[y, x, 2 - c] = np.uint8(tone[at] + 0.5)


class ImageSensor:
    """An image sensor: vignetting, exposure, shot and read noise, tone curve, JPEG compression.

    Args:
        table_rays: float32 [H, W, 3], rays of the pixels in the camera frame with z = 1.
        noise: factor on the standard deviation of shot and read noise; 0 = none.
        vignetting: v in the falloff 1 / (1 + v r^2), r in normalised image coordinates.
        quality: JPEG quality, 0..100.
    """

    def __init__(self, table_rays: np.ndarray, *, noise: float, vignetting: float, quality: int) -> None:
        squared = (table_rays[..., :2] ** 2).sum(axis=-1)
        self._falloff = (1.0 / (1.0 + vignetting * squared)).astype(np.float32)
        self._noise, self._quality = noise, quality

    def develop(self, radiance: np.ndarray, gain: float, rng: np.random.Generator) -> np.ndarray:
        """Return the BGR image uint8 [H, W, 3] of RGB radiance float32 [H, W, 3] times exposure `gain`."""
        out = np.empty(radiance.shape, np.uint8)
        grain = rng.standard_normal(radiance.shape, dtype=np.float32)
        shot, read = SHOT_NOISE * self._noise**2, READ_NOISE * self._noise**2
        _develop(radiance, gain, self._falloff, grain, TONE, shot, read, out)
        return out

    def jpeg(self, bgr: np.ndarray) -> bytes:
        """Return a BGR image uint8 [H, W, 3] compressed as JPEG."""
        return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, self._quality])[1].tobytes()
