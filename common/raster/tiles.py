"""Alpha blending of the splats of a tile, front to back, and its gradient.

The pixels of a tile are in a scratch array, `ROWS` image rows per vector. A pixel whose transmittance T would
fall below the minimum ends: its T is stored with negative sign. The gradient is computed front to back, too:
with q = <dL/dout, splat> and Q = contribution of the splats behind to <dL/dout, out>,
dL/dalpha = T q - Q / (1 - alpha), without other state. With v = alpha dL/dalpha, all gradients of a projected
splat are moments of v over dx, dy and weighted sums (eleven sums per slot).
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import inner, kernel
from beamsplat.common.raster.layout import (
    ALPHA_MAX,
    LOG2_ALPHA_MIN,
    MIN_TRANSMITTANCE,
    RECORD,
    ROWS,
    SLOT,
    TILE_H,
    TILE_PIXELS,
    TILE_W,
)  # fmt: skip
from beamsplat.common.raster.simd import (
    LANES,
    absolute,
    any_lane,
    broadcast,
    floor,
    fma,
    iota,
    maximum,
    minimum,
    reciprocal,
    where,
)
from beamsplat.common.raster.simd_math import exp2_lanes
from beamsplat.common.raster.simd_memory import (
    aligned_floats,
    atomic_next,
    load,
    prefetch,
    store,
    store_sums4,
)

_PREFETCH = 8  # records are prefetched this many splats ahead, because they are not contiguous in depth order
_CHECK_INTERVAL = 8  # after this many splats, check whether all pixels of the tile have ended
# Scratch array: for each vector of pixels one vector per quantity, interleaved, because separate planes would
# alias in the cache at 4096 bytes. Forward: transmittance T, R, G, B, depth D; backward: T, Q, and the
# gradient's five channels.
T, R, G, B, D = (i * LANES for i in range(5))
Q, GR, GG, GB, GD, GA = (i * LANES for i in range(1, 7))
_FORWARD_STRIDE, _BACKWARD_STRIDE = 5 * LANES, 7 * LANES
_VECTORS = TILE_PIXELS // LANES


@inner
def _any_pixel_open(scratch: np.ndarray, step: int) -> bool:
    best = load(scratch, T)
    for vector in range(1, _VECTORS):
        best = maximum(best, load(scratch, T + vector * step))
    return any_lane(best > 0.0)


@inner
def _pixel_offset(x: int, y: int, step: int) -> int:
    """Return the offset of the pixel (x, y) of a tile in the scratch array."""
    return y // ROWS * step + y % ROWS * TILE_W + x


@inner
def _init_scratch(scratch: np.ndarray, step: int, left: int, top: int, width: int, height: int) -> None:
    """Set the scratch array to zero, and T to 1 for pixels inside the image, -1 outside."""
    scratch[:] = 0.0
    for row in range(TILE_H):
        for column in range(TILE_W):
            inside = left + column < width and top + row < height
            scratch[T + _pixel_offset(column, row, step)] = 1.0 if inside else -1.0


@kernel
def _forward_tile(
    lists: np.ndarray,
    first: int,
    last: int,
    records: np.ndarray,
    left: int,
    top: int,
    scratch: np.ndarray,
    alphas: np.ndarray,
) -> None:
    row_of_lane = floor(iota() * np.float32(1.0 / TILE_W))
    column = iota() - row_of_lane * np.float32(TILE_W) + np.float32(left)
    row_of_lane = row_of_lane + np.float32(top)
    for i in range(first, last):
        if (i - first) % _CHECK_INTERVAL == 0 and not _any_pixel_open(scratch, _FORWARD_STRIDE):
            return
        prefetch(records, lists[min(i + _PREFETCH, last - 1), 0] * RECORD)
        record = lists[i, 0] * RECORD
        begin, end = lists[i, 1] & 255, lists[i, 1] >> 8
        dx = column - records[record]
        constant = fma(dx * dx, records[record + 2], records[record + 5])
        linear = dx * records[record + 3]
        C = broadcast(records[record + 4])
        red, green, blue = (
            broadcast(records[record + 6]),
            broadcast(records[record + 7]),
            broadcast(records[record + 8]),
        )
        z = broadcast(records[record + 9])
        dy = row_of_lane + (np.float32(begin * ROWS) - records[record + 1])
        for at in range(begin * LANES, (end + 1) * LANES, LANES):
            power = fma(dy, fma(dy, C, linear), constant)
            dy = dy + np.float32(ROWS)
            store(alphas, at, where(power >= LOG2_ALPHA_MIN, minimum(exp2_lanes(power), ALPHA_MAX), 0.0))
        for vector in range(begin, end + 1):
            at, alpha = vector * _FORWARD_STRIDE, load(alphas, vector * LANES)
            before = load(scratch, T + at)
            weight = before * alpha
            after = before - weight
            still_open = after > MIN_TRANSMITTANCE
            weight = where(still_open, weight, 0.0)
            store(scratch, T + at, where(still_open, after, -absolute(before)))
            store(scratch, R + at, fma(weight, red, load(scratch, R + at)))
            store(scratch, G + at, fma(weight, green, load(scratch, G + at)))
            store(scratch, B + at, fma(weight, blue, load(scratch, B + at)))
            store(scratch, D + at, fma(weight, z, load(scratch, D + at)))


@kernel
def forward_tiles(
    counter: np.ndarray,
    tiles_x: int,
    background: np.ndarray,
    lists: np.ndarray,
    tile_start: np.ndarray,
    records: np.ndarray,
    image: np.ndarray,
) -> None:
    """Render the tiles that `counter` assigns to this thread into `image` float32 [5, H, W].

    Channels: red, green, blue, accumulated depth (m), alpha.
    """
    height, width = image.shape[1], image.shape[2]
    scratch, alphas = aligned_floats(_VECTORS * _FORWARD_STRIDE), aligned_floats(TILE_PIXELS)
    while True:
        tile = atomic_next(counter, 0)
        if tile >= len(tile_start) - 1:
            return
        left, top = tile % tiles_x * TILE_W, tile // tiles_x * TILE_H
        _init_scratch(scratch, _FORWARD_STRIDE, left, top, width, height)
        _forward_tile(lists, tile_start[tile], tile_start[tile + 1], records, left, top, scratch, alphas)
        for y in range(top, min(top + TILE_H, height)):
            for x in range(left, min(left + TILE_W, width)):
                at = _pixel_offset(x - left, y - top, _FORWARD_STRIDE)
                through = abs(scratch[T + at])
                image[0, y, x] = scratch[R + at] + through * background[0]
                image[1, y, x] = scratch[G + at] + through * background[1]
                image[2, y, x] = scratch[B + at] + through * background[2]
                image[3, y, x] = scratch[D + at]
                image[4, y, x] = np.float32(1.0) - through


@kernel
def _backward_tile(
    lists: np.ndarray,
    first: int,
    last: int,
    records: np.ndarray,
    left: int,
    top: int,
    scratch: np.ndarray,
    alphas: np.ndarray,
    slots: np.ndarray,
) -> None:
    row_of_lane = floor(iota() * np.float32(1.0 / TILE_W))
    column = iota() - row_of_lane * np.float32(TILE_W) + np.float32(left)
    row_of_lane = row_of_lane + np.float32(top)
    nothing = broadcast(np.float32(0.0))
    for i in range(first, last):
        if (i - first) % _CHECK_INTERVAL == 0 and not _any_pixel_open(scratch, _BACKWARD_STRIDE):
            slots[i * SLOT : last * SLOT] = 0.0  # occluded; the memory holds sums of an earlier image
            return
        prefetch(records, lists[min(i + _PREFETCH, last - 1), 0] * RECORD)
        record = lists[i, 0] * RECORD
        begin, end = lists[i, 1] & 255, lists[i, 1] >> 8
        dx = column - records[record]
        constant = fma(dx * dx, records[record + 2], records[record + 5])
        linear = dx * records[record + 3]
        C = broadcast(records[record + 4])
        red, green, blue = (
            broadcast(records[record + 6]),
            broadcast(records[record + 7]),
            broadcast(records[record + 8]),
        )
        z = broadcast(records[record + 9])
        dy = row_of_lane + (np.float32(begin * ROWS) - records[record + 1])
        dy_first = dy
        v_0, v_y, v_yy = nothing, nothing, nothing
        w_red, w_green, w_blue, w_z, w_all = nothing, nothing, nothing, nothing, nothing
        for at in range(begin * LANES, (end + 1) * LANES, LANES):
            power = fma(dy_first, fma(dy_first, C, linear), constant)
            dy_first = dy_first + np.float32(ROWS)
            store(alphas, at, where(power >= LOG2_ALPHA_MIN, minimum(exp2_lanes(power), ALPHA_MAX), 0.0))
        for vector in range(begin, end + 1):
            at, alpha = vector * _BACKWARD_STRIDE, load(alphas, vector * LANES)
            before = load(scratch, T + at)
            weight = before * alpha
            after = before - weight
            still_open = after > MIN_TRANSMITTANCE
            weight = where(still_open, weight, 0.0)
            g_red, g_green, g_blue = load(scratch, GR + at), load(scratch, GG + at), load(scratch, GB + at)
            g_z = load(scratch, GD + at)
            q = fma(g_red, red, fma(g_green, green, fma(g_blue, blue, fma(g_z, z, load(scratch, GA + at)))))
            gain = weight * q
            behind = load(scratch, Q + at) - gain
            store(scratch, T + at, where(still_open, after, -absolute(before)))
            store(scratch, Q + at, behind)
            v = where(
                still_open & (alpha < ALPHA_MAX), gain - behind * (alpha * reciprocal(1.0 - alpha)), 0.0
            )
            v_0 = v_0 + v
            vy = v * dy
            v_y = v_y + vy
            v_yy = fma(vy, dy, v_yy)
            w_red, w_green, w_blue = (
                fma(weight, g_red, w_red),
                fma(weight, g_green, w_green),
                fma(weight, g_blue, w_blue),
            )
            w_z, w_all = fma(weight, g_z, w_z), w_all + weight
            dy = dy + np.float32(ROWS)
        slot, v_x = i * SLOT, v_0 * dx
        store_sums4(slots, slot, v_0, v_x, v_y, v_x * dx)
        store_sums4(slots, slot + 4, v_y * dx, v_yy, w_red, w_green)
        store_sums4(slots, slot + 8, w_blue, w_z, w_all, nothing)


@kernel
def backward_tiles(
    counter: np.ndarray,
    tiles_x: int,
    background: np.ndarray,
    lists: np.ndarray,
    tile_start: np.ndarray,
    records: np.ndarray,
    image: np.ndarray,
    gradient: np.ndarray,
    slots: np.ndarray,
) -> None:
    """Write the eleven gradient sums of each (splat, tile) pair to its slot in `slots` (see the module).

    `image` and `gradient` = dL/d(image) are float32 [5, H, W]: red, green, blue, accumulated depth, alpha.
    """
    height, width = image.shape[1], image.shape[2]
    scratch, alphas = aligned_floats(_VECTORS * _BACKWARD_STRIDE), aligned_floats(TILE_PIXELS)
    while True:
        tile = atomic_next(counter, 0)
        if tile >= len(tile_start) - 1:
            return
        left, top = tile % tiles_x * TILE_W, tile // tiles_x * TILE_H
        _init_scratch(scratch, _BACKWARD_STRIDE, left, top, width, height)
        for y in range(top, min(top + TILE_H, height)):
            for x in range(left, min(left + TILE_W, width)):
                at = _pixel_offset(x - left, y - top, _BACKWARD_STRIDE)
                g0, g1, g2, g3 = gradient[0, y, x], gradient[1, y, x], gradient[2, y, x], gradient[3, y, x]
                # out = sum w c + (1 - A) background: the background term contributes to dL/dA.
                g4 = gradient[4, y, x] - (g0 * background[0] + g1 * background[1] + g2 * background[2])
                alpha = image[4, y, x]
                through = np.float32(1.0) - alpha
                scratch[GR + at], scratch[GG + at], scratch[GB + at] = g0, g1, g2
                scratch[GD + at], scratch[GA + at] = g3, g4
                scratch[Q + at] = (
                    (image[0, y, x] - through * background[0]) * g0
                    + (image[1, y, x] - through * background[1]) * g1
                    + (image[2, y, x] - through * background[2]) * g2
                    + image[3, y, x] * g3
                    + alpha * g4
                )  # fmt: skip
        _backward_tile(
            lists, tile_start[tile], tile_start[tile + 1], records, left, top, scratch, alphas, slots
        )
