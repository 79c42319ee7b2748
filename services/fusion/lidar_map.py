"""Grid map of all returns of a drive in the floor plane, for walls that the present scan cannot measure.

In one image column, a wall may be visible above a low cupboard that hides the wall from the lidar; an earlier
scan from another place may contain that wall. Only for robots that stay on a floor: a tilted lidar measures
at other heights.
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel

_MARGIN = 128  # cells by which the grid grows beyond a return
_MAX_SIDE = 4096  # cells of a side: 164 m, 200 MB. Returns further away move the grid.


class LidarMap:
    """Grid with the number and the mean position of the returns in each cell; grows as required.

    A grid that would become larger than `_MAX_SIDE` is moved to the newest scan; what is outside is dropped.
    """

    def __init__(self, cell_m: float = 0.04) -> None:
        self.cell_m = cell_m
        self._origin = np.zeros(2, dtype=np.int64)  # cell numbers of [0, 0]
        self._cells = np.zeros((0, 0, 3), dtype=np.float32)  # count, sum x, sum y relative to the cell

    def add(self, points_map_m: np.ndarray) -> None:
        """Add the returns float64 [N, 2 or 3] of a scan, in the map frame."""
        if len(points_map_m) == 0:
            return
        xy = points_map_m[:, :2]
        cells = np.floor(xy / self.cell_m).astype(np.int64)
        # Of a scan, only returns within a quarter of the largest grid of its middle one are used.
        near = np.all(np.abs(cells - np.median(cells, axis=0)) < _MAX_SIDE // 4, axis=1)
        xy, cells = xy[near], cells[near]
        if len(xy) == 0:
            return
        self._cover(cells.min(axis=0), cells.max(axis=0))
        inner = xy - (cells + 0.5) * self.cell_m
        column, row = (cells - self._origin).T
        for k, value in enumerate((np.ones(len(xy)), inner[:, 0], inner[:, 1])):
            np.add.at(self._cells[..., k], (row, column), value.astype(np.float32))

    def _cover(self, low: np.ndarray, high: np.ndarray) -> None:
        rows, columns = self._cells.shape[:2]
        if rows and np.all(low >= self._origin) and np.all(high < self._origin + np.array([columns, rows])):
            return
        low, high = low - _MARGIN, high + _MARGIN
        first, last = self._origin, self._origin + np.array([columns - 1, rows - 1])
        if rows:
            middle, half = (low + high) // 2, _MAX_SIDE // 2
            low, high = np.minimum(low, first), np.maximum(high, last)
            large = high - low >= _MAX_SIDE
            low = np.where(large, np.maximum(low, middle - half), low)
            high = np.where(large, np.minimum(high, middle + half - 1), high)
        width, height = high - low + 1
        grown = np.zeros((int(height), int(width), 3), dtype=np.float32)
        a, b = np.maximum(low, first), np.minimum(high, last)  # corners of the part that is in both
        if rows and np.all(a <= b):
            (u, v), (du, dv), (m, n) = a - low, a - first, b - a + 1
            grown[v : v + n, u : u + m] = self._cells[dv : dv + n, du : du + m]
        self._cells, self._origin = grown, low

    def points(self, min_hits: int = 3) -> np.ndarray:
        """Return the mean position (map frame, m) of the returns in every cell with >= `min_hits` returns.

        Returns:
            float64 [N, 2].
        """
        row, column = np.nonzero(self._cells[..., 0] >= min_hits)
        n = self._cells[row, column, 0].astype(np.float64)
        inner = self._cells[row, column, 1:].astype(np.float64) / n[:, None]
        return (np.stack([column, row], axis=1) + self._origin + 0.5) * self.cell_m + inner

    def layers(
        self,
        position_map_m: np.ndarray,  # float64 [2]
        azimuth_map_rad: np.ndarray,  # float64 [M]
        count: int = 4,
        max_range_m: float = 14.0,
        min_hits: int = 2,
    ) -> np.ndarray:
        """Return ranges (m) of mapped surfaces on each ray, float64 [count, M], nearest first; NaN: none."""
        out = np.full((count, len(azimuth_map_rad)), np.nan)
        if self._cells.size:
            cast_rays(
                self._cells, self._origin.astype(np.float64) * self.cell_m, self.cell_m,
                np.asarray(position_map_m, dtype=np.float64), np.asarray(azimuth_map_rad, dtype=np.float64),
                max_range_m, min_hits, out,
            )  # fmt: skip
        return out


@kernel
def cast_rays(
    cells: np.ndarray,  # float32 [rows, columns, 3]
    origin_m: np.ndarray,  # float64 [2]
    cell_m: float,
    start_m: np.ndarray,  # float64 [2]
    azimuth_rad: np.ndarray,  # float64 [M]
    max_range_m: float,
    min_hits: int,
    out: np.ndarray,  # float64 [L, M]
) -> None:
    """Write the ranges (m) of the surfaces along each ray to `out` [count, M], nearest first.

    The step along the ray is half a cell. Consecutive cells with returns count as one surface.
    """
    rows, columns = cells.shape[0], cells.shape[1]
    for k in range(azimuth_rad.shape[0]):
        ca, sa = np.cos(azimuth_rad[k]), np.sin(azimuth_rad[k])
        layer, gap, total, weight = 0, 0, 0.0, 0.0
        last_i, last_j = -1, -1
        r = 0.15
        while r < max_range_m and layer < out.shape[0]:
            j = int(np.floor((start_m[0] + r * ca - origin_m[0]) / cell_m))
            i = int(np.floor((start_m[1] + r * sa - origin_m[1]) / cell_m))
            hit = 0 <= i < rows and 0 <= j < columns and cells[i, j, 0] >= min_hits
            if hit:
                gap = 0
                if i != last_i or j != last_j:
                    n = cells[i, j, 0]
                    x = origin_m[0] + (j + 0.5) * cell_m + cells[i, j, 1] / n - start_m[0]
                    y = origin_m[1] + (i + 0.5) * cell_m + cells[i, j, 2] / n - start_m[1]
                    total += n * (x * ca + y * sa)
                    weight += n
                    last_i, last_j = i, j
            elif weight > 0.0:
                gap += 1
                if gap > 2:
                    out[layer, k] = total / weight
                    layer, gap, total, weight = layer + 1, 0, 0.0, 0.0
            r += 0.5 * cell_m
        if weight > 0.0 and layer < out.shape[0]:
            out[layer, k] = total / weight
