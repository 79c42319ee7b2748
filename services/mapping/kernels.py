"""Loss and optimiser of the mapper as compiled loops on arrays."""

from __future__ import annotations

import numpy as np

from common.raster.compiled import kernel
from common.raster.lanes import exp2_lanes
from common.raster.layout import COLOUR, GRADIENTS, MEAN, OPACITY, PARAMS, QUAT, SCALE, WEIGHT
from common.raster.simd import LANES, any_lane, fma, larger, repeat, root, smaller, where
from common.raster.simd_memory import atomic_next, gather, load, scatter_some

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-15
_LOG2_BETA_1, _LOG2_BETA_2 = float(np.log2(BETA_1)), float(np.log2(BETA_2))


@kernel
def photometric_and_depth(  # noqa: ANN201
    counter, image, rgb, depth_mm, depth_weight, exposure, colour_scale, depth_scale, gradient, sums,  # noqa: ANN001
):  # fmt: skip
    """L1 of colour (after exposure) and of depth, and their gradient, by image rows handed out to threads.

    Args:
        image: float32 [5, H, W] as rendered. rgb: uint8 [3, H, W]. depth_mm: uint16 [H, W], 0 unknown.
        depth_weight: uint8 [H, W], 255 = weight 1. exposure: float32 [6], log gains and offsets.
        colour_scale, depth_scale: factors of the two terms per pixel.
        gradient: float32 [5, H, W], overwritten. sums: float64 [H, 8]: per row |colour error|, weighted
            |depth error| (m), weights, and dL/dgain, dL/doffset of the three channels summed (last 4 unused).

    The depth term is w |sum w_i z_i - d alpha| (m): zero where the surface is right, whatever its opacity.
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
            d_gain, d_offset = np.float32(0.0), np.float32(0.0)
            for x in range(width):
                shown = image[channel, y, x] * gain
                error = shown + offset - np.float32(rgb[channel, y, x]) * to_unit
                slope = np.float32(1.0) if error > 0.0 else np.float32(-1.0)
                g = slope * colour_scale
                gradient[channel, y, x] = g * gain
                total += abs(error)
                d_gain += g * shown
                d_offset += g
            sums[y, 2 + channel] = d_gain
            sums[y, 5 + channel] = d_offset
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
def add_lidar(image, pixels, z_m, scale, gradient):  # noqa: ANN001, ANN201
    """Adds the gradient of scale * |rendered - measured depth| at the beams' pixels int32 [N] (flat)."""
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
def adam(  # noqa: ANN201
    counter, gradients, index, params, first, second, steps, rates, isotropy, ratio_log,  # noqa: ANN001
):  # fmt: skip
    """One step of Adam on the Gaussians that were seen (Kingma & Ba 2015), each with its own count of steps.

    Args:
        gradients: float32 [GRADIENTS, >= V]. index: int32 [>= V], padded. params, first, second: float32
            [PARAMS, capacity]. steps: float32 [capacity]. rates: float32 [PARAMS].
        isotropy: pulls the longest axis towards the second where it is more than e**ratio_log as long, in
            proportion to the Gaussian's share of the picture: needles show from other views.
    """
    visible, stride = len(index), params.shape[1]
    g_flat, p_flat, m_flat, v_flat = (
        gradients.reshape(-1),
        params.reshape(-1),
        first.reshape(-1),
        second.reshape(-1),
    )
    wide = gradients.shape[1]
    block = 64 * LANES
    while True:
        begin = atomic_next(counter, 0) * block
        if begin >= visible:
            return
        for at in range(begin, min(visible, begin + block), LANES):
            if not any_lane(load(g_flat, WEIGHT * wide + at) > 0.0):  # hidden: nothing to learn
                continue
            used = min(LANES, visible - at)
            t = gather(steps, 0, index, at) + 1.0
            scatter_some(steps, 0, index, at, t, used)
            fix_1 = 1.0 / (1.0 - exp2_lanes(larger(t * _LOG2_BETA_1, -100.0)))
            fix_2 = 1.0 / (1.0 - exp2_lanes(larger(t * _LOG2_BETA_2, -100.0)))
            a = gather(p_flat, SCALE * stride, index, at)
            b = gather(p_flat, (SCALE + 1) * stride, index, at)
            c = gather(p_flat, (SCALE + 2) * stride, index, at)
            longest = larger(a, larger(b, c))
            middle = larger(smaller(a, b), smaller(larger(a, b), c))
            pull = larger(longest - middle - ratio_log, 0.0) * isotropy * load(g_flat, WEIGHT * wide + at)
            for row in range(PARAMS):
                g = load(g_flat, row * wide + at)
                p = gather(p_flat, row * stride, index, at)
                if SCALE <= row < QUAT:
                    g = g + where(p >= longest, pull, 0.0)
                m = gather(m_flat, row * stride, index, at)
                v = gather(v_flat, row * stride, index, at)
                m = fma(g - m, repeat(np.float32(1.0 - BETA_1)), m)
                v = fma(g * g - v, repeat(np.float32(1.0 - BETA_2)), v)
                scatter_some(m_flat, row * stride, index, at, m, used)
                scatter_some(v_flat, row * stride, index, at, v, used)
                move = m * fix_1 / (root(v * fix_2) + EPSILON)
                scatter_some(p_flat, row * stride, index, at, p - move * rates[row], used)


@kernel
def contradicted(  # noqa: ANN201
    params, count, camera, depth_mm, depth_weight, least_weight, margin, strikes,  # noqa: ANN001
):  # fmt: skip
    """strikes[i] += 1 for Gaussians whose centre floats before a surface that is known well.

    A Gaussian at z counts as floating if its pixel's depth d is trusted (weight >= least_weight) and
    z + 3 sigma < d (1 - margin). Gives how many were struck. `camera` as packed for the rasterizer.
    """
    height, width = depth_mm.shape
    c, struck = camera, 0
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
            strikes[i] += 1
            struck += 1
    return struck


def rate_rows(mean: float, log_scale: float, quat: float, opacity: float, colour: float) -> np.ndarray:
    """float32 [PARAMS] of `adam` from one rate per group."""
    rows = np.empty(PARAMS, np.float32)
    rows[MEAN:SCALE], rows[SCALE:QUAT], rows[QUAT:OPACITY] = mean, log_scale, quat
    rows[OPACITY:COLOUR], rows[COLOUR:] = opacity, colour
    return rows


assert GRADIENTS > PARAMS
