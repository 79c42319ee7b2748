"""From the working size to the picture's: depth along its edges, and a standard deviation per pixel."""

from __future__ import annotations

import numpy as np
from numba import njit

jit = njit(nogil=True, cache=True, error_model="numpy")


@jit
def enlarge(
    depth: np.ndarray,  # float32 [h, w], NaN = unknown
    sigma_log: np.ndarray,  # float32 [h, w]
    colour: np.ndarray,  # uint8 [h, w, 3] of the small picture
    full_colour: np.ndarray,  # uint8 [H, W, 3]
    same: float,  # log depth: neighbours closer than this are one surface
    depth_out: np.ndarray,  # float32 [H, W]
    sigma_out: np.ndarray,  # float32 [H, W], metres
) -> None:
    """On one surface 1/z is linear in the pixel (exact on planes); at edges and holes like colour decides."""
    h, w = depth.shape
    H, W = depth_out.shape
    for V in range(H):
        y = min(max((V + 0.5) * h / H - 0.5, 0.0), h - 1.0)
        i0 = min(int(y), h - 2)
        b = y - i0
        for U in range(W):
            x = min(max((U + 0.5) * w / W - 0.5, 0.0), w - 1.0)
            j0 = min(int(x), w - 2)
            a = x - j0
            low, high, holes = np.inf, 0.0, False
            for i in range(i0, i0 + 2):
                for j in range(j0, j0 + 2):
                    z = depth[i, j]
                    if not z > 0.0:
                        holes = True
                    else:
                        low, high = min(low, z), max(high, z)
            if not holes and high < low * (1.0 + same):
                inv = (1 - b) * ((1 - a) / depth[i0, j0] + a / depth[i0, j0 + 1])
                inv += b * ((1 - a) / depth[i0 + 1, j0] + a / depth[i0 + 1, j0 + 1])
                s = (1 - b) * ((1 - a) * sigma_log[i0, j0] + a * sigma_log[i0, j0 + 1])
                s += b * ((1 - a) * sigma_log[i0 + 1, j0] + a * sigma_log[i0 + 1, j0 + 1])
                depth_out[V, U] = 1.0 / inv
                sigma_out[V, U] = s / inv
                continue
            best, best_i, best_j = np.inf, i0, j0
            for i in range(i0, i0 + 2):
                for j in range(j0, j0 + 2):
                    away = 8.0 * (abs(y - i) + abs(x - j))
                    for k in range(3):
                        away += abs(float(full_colour[V, U, k]) - float(colour[i, j, k]))
                    if away < best:
                        best, best_i, best_j = away, i, j
            if depth[best_i, best_j] > 0.0:
                depth_out[V, U] = depth[best_i, best_j]
                sigma_out[V, U] = depth[best_i, best_j] * sigma_log[best_i, best_j]
            else:
                depth_out[V, U] = np.nan
                sigma_out[V, U] = np.nan
