"""Likelihood of surfaces at all scales: the grids that branch and bound reads."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d.table_kernels import FIELD_SIGMA_M

FIELD_CELL_M = 0.1  # cell of the field of `search_pyramid`, half a search cell
LEVELS = 6  # a cell of the coarsest level covers 2^5 x 2^5 search cells


@dataclass(frozen=True)
class SearchPyramid:
    """Precomputed grids for branch and bound.

    A cell of level h contains the maximum likelihood of the 2^h x 2^h search cells that start at this cell.
    """

    levels: np.ndarray  # uint8 [LEVELS, H, W], padded by 2^(LEVELS - 1) on all sides
    row0: int  # search cell of the first row of the padded arrays
    col0: int
    cell_m: float


@kernel
def _fill(field: np.ndarray, shift_r: int, shift_c: int, levels: np.ndarray) -> None:
    """Compute all levels of the pyramid from the likelihood field, shifted by whole field cells."""
    for r in range(field.shape[0]):
        for c in range(field.shape[1]):
            rr, cc = (r + shift_r) >> 1, (c + shift_c) >> 1
            if field[r, c] > levels[0, rr, cc]:
                levels[0, rr, cc] = field[r, c]
    rows, cols = levels.shape[1], levels.shape[2]
    for h in range(1, levels.shape[0]):
        d = 1 << (h - 1)
        for r in range(rows):
            r2 = min(r + d, rows - 1)
            for c in range(cols):
                c2 = min(c + d, cols - 1)
                levels[h, r, c] = max(
                    max(levels[h - 1, r, c], levels[h - 1, r2, c]),
                    max(levels[h - 1, r, c2], levels[h - 1, r2, c2]),
                )


def build_pyramid(field: np.ndarray, row0: int, col0: int, cell_m: float) -> SearchPyramid:
    """Return the search pyramid of a likelihood field uint8 [H, W] whose first cell is (row0, col0).

    Search cells are twice as large as the cells of the field.
    """
    pad = 1 << (LEVELS - 1)
    r0, c0 = row0 >> 1, col0 >> 1
    rows = ((row0 + field.shape[0]) >> 1) - r0 + 1
    cols = ((col0 + field.shape[1]) >> 1) - c0 + 1
    levels = np.zeros((LEVELS, rows + 2 * pad, cols + 2 * pad), dtype=np.uint8)
    _fill(field, row0 - 2 * r0 + 2 * pad, col0 - 2 * c0 + 2 * pad, levels)
    return SearchPyramid(levels, r0 - pad, c0 - pad, 2.0 * cell_m)


@kernel
def _fill_field(
    means: np.ndarray, row0: int, col0: int, cell_m: float, sigma_m: float, field: np.ndarray
) -> None:
    """Write to `field` the largest likelihood that a surface element causes anywhere in each cell."""
    for i in range(means.shape[0]):
        row, col = math.floor(means[i, 1] / cell_m), math.floor(means[i, 0] / cell_m)
        for r in range(row - 1, row + 2):
            for c in range(col - 1, col + 2):
                if r < row0 or c < col0 or r >= row0 + field.shape[0] or c >= col0 + field.shape[1]:
                    continue
                dx = max(c * cell_m - means[i, 0], means[i, 0] - (c + 1) * cell_m, 0.0)
                dy = max(r * cell_m - means[i, 1], means[i, 1] - (r + 1) * cell_m, 0.0)
                value = np.uint8(255.0 * math.exp(-0.5 * (dx * dx + dy * dy) / (sigma_m * sigma_m)))
                if value > field[r - row0, c - col0]:
                    field[r - row0, c - col0] = value


def search_pyramid(means: np.ndarray) -> SearchPyramid:
    """Return the search pyramid, of 0.2 m per cell, of surface elements with these means float [S, 2]."""
    means = means.astype(np.float64)
    if len(means) == 0:
        return build_pyramid(np.zeros((2, 2), dtype=np.uint8), 0, 0, FIELD_CELL_M)
    low = np.floor(means.min(axis=0) / FIELD_CELL_M).astype(np.int64) - 1
    high = np.floor(means.max(axis=0) / FIELD_CELL_M).astype(np.int64) + 2
    field = np.zeros((int(high[1] - low[1]), int(high[0] - low[0])), dtype=np.uint8)
    _fill_field(means, int(low[1]), int(low[0]), FIELD_CELL_M, FIELD_SIGMA_M, field)
    return build_pyramid(field, int(low[1]), int(low[0]), FIELD_CELL_M)
