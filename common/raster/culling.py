"""View-frustum culling of Gaussians, and a radix sort of the visible ones by depth."""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.common.raster.layout import BLUR_PX2, SCALE
from beamsplat.common.raster.simd import LANES, any_lane, maximum, where
from beamsplat.common.raster.simd_math import exp_lanes
from beamsplat.common.raster.simd_memory import aligned_floats, atomic_next, load, store

BLOCK = 4096  # Gaussians per unit of work of a thread


@kernel
def cull(
    counter: np.ndarray,
    params: np.ndarray,
    stride: int,
    count: int,
    camera: np.ndarray,
    index: np.ndarray,
    depth: np.ndarray,
    kept: np.ndarray,
) -> None:
    """Write index and depth z (m) of the possibly visible Gaussians to `index` and `depth`.

    Processes the blocks of Gaussians that `counter` assigns to this thread. The bound is conservative: 3.4
    times the largest scale, projected at the steepest viewing ray. `params` is float32 [14 * stride]. The
    results of a block start at block * BLOCK in `index` and `depth`; their number is written to kept[block].
    """
    r = camera
    steep = max(max(-camera[16], camera[17]), max(-camera[18], camera[19]))
    focal = max(camera[12], camera[13]) * np.float32(np.sqrt(1.0 + steep * steep))
    pad = np.float32(1.0 + 3.4 * np.sqrt(BLUR_PX2))
    lanes = aligned_floats(2 * LANES)
    blocks = (count + BLOCK - 1) // BLOCK
    while True:
        block = atomic_next(counter, 0)
        if block >= blocks:
            return
        first, last = block * BLOCK, min(count, (block + 1) * BLOCK)
        n = first
        for i in range(first, last, LANES):
            x, y, z = load(params, i), load(params, stride + i), load(params, 2 * stride + i)
            zc = x * r[6] + y * r[7] + z * r[8] + r[11]
            ahead = zc > camera[22]
            if not any_lane(ahead):
                continue
            xc = x * r[0] + y * r[1] + z * r[2] + r[9]
            yc = x * r[3] + y * r[4] + z * r[5] + r[10]
            s = maximum(load(params, SCALE * stride + i), load(params, (SCALE + 1) * stride + i))
            s = exp_lanes(maximum(s, load(params, (SCALE + 2) * stride + i)))
            inverse = 1.0 / zc
            reach = s * inverse * (focal * np.float32(3.4)) + pad
            u, v = xc * inverse * camera[12] + camera[14], yc * inverse * camera[13] + camera[15]
            seen = ahead & (u + reach > 0.0) & (u - reach < camera[20])
            seen = seen & (v + reach > 0.0) & (v - reach < camera[21])
            if not any_lane(seen):
                continue
            store(lanes, 0, zc)
            store(lanes, LANES, where(seen, 1.0, 0.0))
            for k in range(min(LANES, last - i)):
                index[n] = i + k
                depth[n] = lanes[k]
                n += lanes[LANES + k] > 0.0
        kept[block] = n - first


@kernel
def compact(index: np.ndarray, depth: np.ndarray, kept: np.ndarray) -> int:
    """Remove the gaps between blocks in place, and return the number of visible Gaussians.

    `index` is padded with its last entry, so that a whole vector can be read at the end.
    """
    n = 0
    for block in range(len(kept)):
        first = block * BLOCK
        for i in range(first, first + kept[block]):
            index[n], depth[n] = index[i], depth[i]
            n += 1
    if n > 0:
        index[n : n + LANES] = index[n - 1]
    return n


@kernel
def sort_by_depth(
    depth: np.ndarray,
    n: int,
    order: np.ndarray,
    keys: np.ndarray,
    keys_other: np.ndarray,
    order_other: np.ndarray,
) -> None:
    """Write the indices 0 .. n - 1 to `order`, sorted by `depth`, nearest first; the sort is stable.

    Radix sort (least significant digit first) on the bits of positive floats, 11 bits per pass, with only as
    many passes as the range of depths needs. The other arrays [n] are buffers.
    """
    bits = depth.view(np.uint32)
    low, high = np.uint32(0xFFFFFFFF), np.uint32(0)
    for i in range(n):
        keys[i], order[i] = bits[i], i
        low, high = min(low, bits[i]), max(high, bits[i])
    if n == 0:
        return
    histogram = np.empty(2048, np.int64)
    spread, shift, flipped = high - low, 0, False
    while shift < 32 and (spread >> np.uint32(shift)) > 0:
        if flipped:
            _radix_pass(keys_other, order_other, keys, order, histogram, n, low, shift)
        else:
            _radix_pass(keys, order, keys_other, order_other, histogram, n, low, shift)
        flipped = not flipped
        shift += 11
    if flipped:
        order[:n] = order_other[:n]


@kernel
def _radix_pass(
    keys: np.ndarray,
    order: np.ndarray,
    keys_out: np.ndarray,
    order_out: np.ndarray,
    histogram: np.ndarray,
    n: int,
    low: np.uint32,
    shift: int,
) -> None:
    s = np.uint32(shift)
    histogram[:] = 0
    for i in range(n):
        histogram[((keys[i] - low) >> s) & np.uint32(2047)] += 1
    total = 0
    for digit in range(2048):
        here = histogram[digit]
        histogram[digit] = total
        total += here
    for i in range(n):
        digit = ((keys[i] - low) >> s) & np.uint32(2047)
        at = histogram[digit]
        keys_out[at], order_out[at] = keys[i], order[i]
        histogram[digit] = at + 1
