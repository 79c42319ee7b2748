"""Kernels of the match tables: nearest surface element of every cell, and the likelihood field."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel

FIELD_SIGMA_M = 0.06  # standard deviation of the likelihood field


@kernel
def splat(
    nearest: np.ndarray,  # int32 [H, W]
    field: np.ndarray,  # uint8 [H, W]
    means: np.ndarray,  # float64 [S, 2]
    omegas: np.ndarray,  # float64 [S, 3]
    index: int,
    row: int,
    col: int,
    row0: int,
    col0: int,
    cell_m: float,
    reach: int,
) -> None:
    """Write a surface element to `nearest` in the cells closest to it; raise the likelihood around it."""
    mx, my = means[index, 0], means[index, 1]
    trace = omegas[index, 0] + omegas[index, 2]
    for r in range(max(row - reach, 0), min(row + reach + 1, nearest.shape[0])):
        cy = (r + row0 + 0.5) * cell_m - my
        for c in range(max(col - reach, 0), min(col + reach + 1, nearest.shape[1])):
            cx = (c + col0 + 0.5) * cell_m - mx
            d2 = cx * cx + cy * cy
            k = nearest[r, c]
            if k >= 0 and k != index:
                ex, ey = cx + mx - means[k, 0], cy + my - means[k, 1]
                if d2 < ex * ex + ey * ey:
                    nearest[r, c] = index
            else:
                nearest[r, c] = index
            # Squared distance: across the surface with weight 1, along it with weight 1/4.
            across = (
                omegas[index, 0] * cx * cx + 2.0 * omegas[index, 1] * cx * cy + omegas[index, 2] * cy * cy
            ) / trace
            d2f = across + 0.25 * max(d2 - across, 0.0)
            if d2f < 9.0 * FIELD_SIGMA_M * FIELD_SIGMA_M:
                v = 255.0 * math.exp(-0.5 * d2f / (FIELD_SIGMA_M * FIELD_SIGMA_M))
                if v > field[r, c]:
                    field[r, c] = np.uint8(v)


@kernel
def splat_all(
    nearest: np.ndarray,
    field: np.ndarray,
    means: np.ndarray,
    omegas: np.ndarray,
    cells: np.ndarray,
    row0: int,
    col0: int,
    cell_m: float,
    reach: int,
) -> None:
    """Fill the table `nearest` and the likelihood `field`, both empty before, from all surface elements."""
    for i in range(len(means)):
        splat(
            nearest,
            field,
            means,
            omegas,
            i,
            cells[i, 0] - row0,
            cells[i, 1] - col0,
            row0,
            col0,
            cell_m,
            reach,
        )


@kernel
def nearest_all(
    nearest: np.ndarray,  # out int32 [H, W]
    means: np.ndarray,  # float64 [S, 2]
    cells: np.ndarray,  # int64 [S, 2] row, col (absolute)
    row0: int,
    col0: int,
    cell_m: float,
    reach: int,
) -> None:
    """Fill the table `nearest` from all surface elements, like `splat_all` without the likelihood field."""
    best = np.full(nearest.shape, np.inf, dtype=np.float32)
    for i in range(len(means)):
        row, col = cells[i, 0] - row0, cells[i, 1] - col0
        for r in range(max(row - reach, 0), min(row + reach + 1, nearest.shape[0])):
            dy = (r + row0 + 0.5) * cell_m - means[i, 1]
            for c in range(max(col - reach, 0), min(col + reach + 1, nearest.shape[1])):
                dx = (c + col0 + 0.5) * cell_m - means[i, 0]
                d2 = dx * dx + dy * dy
                if d2 < best[r, c]:
                    best[r, c] = d2
                    nearest[r, c] = i
