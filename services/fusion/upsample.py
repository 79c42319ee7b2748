"""Edge-aware upsampling of depth and its standard deviation from the working size to the image size."""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel


@kernel
def upsample_depth(
    depth: np.ndarray,  # float32 [h, w], NaN = unknown
    sigma_log: np.ndarray,  # float32 [h, w]
    colour: np.ndarray,  # uint8 [h, w, 3] image at the working size
    full_colour: np.ndarray,  # uint8 [H, W, 3]
    same: float,  # log depth: pixels that differ by less belong to one surface
    depth_out: np.ndarray,  # float32 [H, W]
    sigma_out: np.ndarray,  # float32 [H, W], metres
) -> None:
    """Upsample depth and sigma of log depth from [h, w] to [H, W]; write `depth_out` and `sigma_out` (m).

    Within one surface 1/z is interpolated bilinearly, which is exact on planes. At depth edges and unknown
    pixels, the output pixel takes the value of the working-size pixel with the most similar colour.
    """
    h, w = depth.shape
    H, W = depth_out.shape
    inverse = np.empty((h, w), np.float32)
    for i in range(h):
        for j in range(w):
            inverse[i, j] = np.float32(1.0) / depth[i, j]
    column_index, column_weight = np.empty(W, np.int64), np.empty(W, np.float32)
    for U in range(W):
        x = min(max((U + 0.5) * w / W - 0.5, 0.0), w - 1.0)
        column_index[U] = min(int(x), w - 2)
        column_weight[U] = x - column_index[U]
    most = np.float32(1.0 + same)
    flat = np.empty(w - 1, np.bool_)
    last_i0 = -1
    for V in range(H):
        y = min(max((V + 0.5) * h / H - 0.5, 0.0), h - 1.0)
        i0 = min(int(y), h - 2)
        b = np.float32(y - i0)
        if i0 != last_i0:
            last_i0 = i0
            for j in range(w - 1):
                flat[j] = _one_surface(depth, i0, j, most)
        for U in range(W):
            j0, a = column_index[U], column_weight[U]
            if flat[j0]:
                w11 = a * b
                w01, w10 = a - w11, b - w11
                w00 = np.float32(1.0) - a - w10
                near = w00 * inverse[i0, j0] + w01 * inverse[i0, j0 + 1]
                near += w10 * inverse[i0 + 1, j0] + w11 * inverse[i0 + 1, j0 + 1]
                s = w00 * sigma_log[i0, j0] + w01 * sigma_log[i0, j0 + 1]
                s += w10 * sigma_log[i0 + 1, j0] + w11 * sigma_log[i0 + 1, j0 + 1]
                z = np.float32(1.0) / near
                depth_out[V, U] = z
                sigma_out[V, U] = s * z
                continue
            i, j = _most_similar_pixel(colour, full_colour, V, U, i0, j0, a, b)
            depth_out[V, U] = depth[i, j]  # NaN stays NaN
            sigma_out[V, U] = depth[i, j] * sigma_log[i, j]


@kernel
def _one_surface(depth: np.ndarray, i0: int, j0: int, most: np.float32) -> bool:
    """Return whether the 2x2 pixels from [i0, j0] have depths that differ by less than the factor `most`."""
    low, high = np.inf, 0.0
    for i in range(i0, i0 + 2):
        for j in range(j0, j0 + 2):
            if not depth[i, j] > 0.0:
                return False
            low, high = min(low, depth[i, j]), max(high, depth[i, j])
    return bool(high < low * most)


@kernel
def _most_similar_pixel(
    colour: np.ndarray,
    full_colour: np.ndarray,
    V: int,
    U: int,
    i0: int,
    j0: int,
    a: np.float32,
    b: np.float32,
) -> tuple[int, int]:
    """Return the pixel of the 2x2 block at [i0, j0] whose colour and position are most similar to [V, U]."""
    best, best_i, best_j = np.float32(1e9), i0, j0
    for i in range(i0, i0 + 2):
        for j in range(j0, j0 + 2):
            difference = np.float32(8.0) * (abs(b - np.float32(i - i0)) + abs(a - np.float32(j - j0)))
            for k in range(3):
                difference += abs(np.float32(full_colour[V, U, k]) - np.float32(colour[i, j, k]))
            if difference < best:
                best, best_i, best_j = difference, i, j
    return best_i, best_j
