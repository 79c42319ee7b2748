"""Losses and free-space carving of the mapper as compiled loops on arrays."""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.common.raster.layout import MEAN, SCALE
from beamsplat.common.raster.simd_memory import atomic_next


@kernel
def photometric_and_depth(
    counter: np.ndarray,
    image: np.ndarray,
    rgb: np.ndarray,
    depth_mm: np.ndarray,
    depth_weight: np.ndarray,
    exposure: np.ndarray,
    colour_scale: np.float32,
    depth_scale: np.float32,
    gradient: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Compute the L1 losses of colour (after exposure) and of depth, and their gradients.

    The depth term is weight * depth_scale * |D - d alpha|, with the accumulated depth D (channel 3 of
    `image`) and the measured depth d (m). It is zero at the right depth, for any opacity. Every thread runs
    this function and processes the next image row until no row is left.

    Args:
        counter: number of the next row, shared by the threads.
        image: float32 [5, H, W], the render: red, green, blue in [0, 1], accumulated depth (m), alpha.
        rgb: uint8 [3, H, W], image of the keyframe.
        depth_mm: uint16 [H, W], measured optical z, 0 = unknown.
        depth_weight: uint8 [H, W], 255 = weight 1.
        exposure: float32 [6], log gains of red, green, blue, then offsets of red, green, blue (not log). The
            rendered colour is compared after exp(log gain) * colour + offset.
        colour_scale, depth_scale: factors of the two losses, per pixel.
        gradient: out float32 [5, H, W], derivative of the loss with respect to `image`.
        sums: out float64 [H, 2], per row: sum of |colour error| and depth loss.
    """
    height, width = image.shape[1], image.shape[2]
    to_unit = np.float32(1.0 / 255.0)
    while True:
        y = atomic_next(counter, 0)
        if y >= height:
            return
        total = np.float32(0.0)
        for channel in range(3):
            gain, offset = np.float32(np.exp(exposure[channel])), exposure[3 + channel]
            for x in range(width):
                error = image[channel, y, x] * gain + offset - np.float32(rgb[channel, y, x]) * to_unit
                slope = np.float32(1.0) if error > 0.0 else np.float32(-1.0)
                gradient[channel, y, x] = slope * colour_scale * gain
                total += abs(error)
        sums[y, 0] = total
        depth_total = np.float32(0.0)
        for x in range(width):
            d = np.float32(depth_mm[y, x]) * np.float32(1e-3)
            w = np.float32(depth_weight[y, x]) * to_unit * depth_scale
            w = w if d > 0.0 else np.float32(0.0)
            error = image[3, y, x] - d * image[4, y, x]
            slope = w if error > 0.0 else -w
            gradient[3, y, x] = slope
            gradient[4, y, x] = -slope * d
            depth_total += w * abs(error)
        sums[y, 1] = depth_total


@kernel
def exposure_gradient(
    counter: np.ndarray, image: np.ndarray, gradient: np.ndarray, exposure: np.ndarray, sums: np.ndarray
) -> None:
    """Compute the derivatives of the loss with respect to the exposure.

    All losses of colour compare s = exp(log gain) * colour + offset. So dL/d(colour) = exp(log gain) * dL/ds
    contains the derivatives dL/d(offset) = sum of dL/ds and dL/d(log gain) = sum of colour * dL/d(colour).

    Args:
        counter, image, exposure: as in `photometric_and_depth`.
        gradient: float32 [5, H, W], complete derivative of the loss with respect to `image`, zero at hidden
            pixels.
        sums: out float64 [H, 6], per row: derivatives with respect to the log gains, then to the offsets.
    """
    height, width = image.shape[1], image.shape[2]
    while True:
        y = atomic_next(counter, 0)
        if y >= height:
            return
        for channel in range(3):
            d_gain, d_shown = np.float32(0.0), np.float32(0.0)
            for x in range(width):
                g = gradient[channel, y, x]
                d_gain += g * image[channel, y, x]
                d_shown += g
            sums[y, channel] = d_gain
            sums[y, 3 + channel] = d_shown / np.float32(np.exp(exposure[channel]))


@kernel
def add_lidar(
    image: np.ndarray, pixels: np.ndarray, z_m: np.ndarray, scale: np.float32, gradient: np.ndarray
) -> float:
    """Add the loss of the lidar beams to the gradient; return the loss.

    The loss is scale * |D - z alpha|, summed over the beams, with the accumulated depth D of the render.

    Args:
        image: float32 [5, H, W], the render: red, green, blue, accumulated depth (m), alpha.
        pixels: int32 [N], flat pixel indices of the beams. z_m: float32 [N], their measured optical z.
        gradient: in out float32 [5, H, W].
    """
    flat, g = image.reshape(5, -1), gradient.reshape(5, -1)
    total = 0.0
    for i in range(len(pixels)):
        at = pixels[i]
        error = flat[3, at] - z_m[i] * flat[4, at]
        slope = scale if error > 0.0 else -scale
        g[3, at] += slope
        g[4, at] -= slope * z_m[i]
        total += abs(error) * scale
    return total


@kernel
def count_carving_votes(
    params: np.ndarray,
    count: int,
    camera: np.ndarray,
    depth_mm: np.ndarray,
    depth_weight: np.ndarray,
    least_weight: np.uint8,
    margin: float,
    votes: np.ndarray,
) -> int:
    """Add 1 to votes[i] for each Gaussian i that floats in front of a trusted surface; return their number.

    A Gaussian at optical z is floating if the depth d of its pixel is trusted (weight >= least_weight) and
    z + 3 sigma < d (1 - margin), with its largest standard deviation sigma. Only the first `count` columns of
    `params` float32 [14, N] are tested. `camera` is the result of RasterCamera.packed().
    """
    height, width = depth_mm.shape
    c, voted = camera, 0
    for i in range(count):
        x, y, z = params[MEAN, i], params[MEAN + 1, i], params[MEAN + 2, i]
        zc = c[6] * x + c[7] * y + c[8] * z + c[11]
        if zc < c[22]:
            continue
        u = int(np.floor((c[0] * x + c[1] * y + c[2] * z + c[9]) / zc * c[12] + c[14] + 0.5))
        v = int(np.floor((c[3] * x + c[4] * y + c[5] * z + c[10]) / zc * c[13] + c[15] + 0.5))
        if u < 0 or v < 0 or u >= width or v >= height or depth_weight[v, u] < least_weight:
            continue
        d = depth_mm[v, u] * np.float32(1e-3)
        size = np.exp(max(params[SCALE, i], max(params[SCALE + 1, i], params[SCALE + 2, i])))
        if d > 0.0 and zc + 3.0 * size < d * (1.0 - margin):
            votes[i] += 1
            voted += 1
    return voted
