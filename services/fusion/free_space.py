"""Detection of beams on dynamic objects: returns in grid cells that earlier beams have passed through."""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel


class FreeSpaceGrid:
    """Grid over the floor; counts the beams that passed each cell and the beams that ended in it."""

    def __init__(self, cell_m: float = 0.1, side_m: float = 60.0) -> None:
        cells = round(side_m / cell_m)
        self.cell_m = cell_m
        self._low_m = -0.5 * side_m
        self._pass_count = np.zeros((cells, cells), dtype=np.uint16)
        self._hit_count = np.zeros((cells, cells), dtype=np.uint16)

    def add(self, position_map_m: np.ndarray, points_map_m: np.ndarray) -> None:
        """Add a scan taken at `position_map_m` [2 or 3] with returns [N, 2 or 3], both in the map frame."""
        start = np.asarray(position_map_m, dtype=np.float64)[:2].copy()
        ends = np.ascontiguousarray(points_map_m[:, :2], dtype=np.float64)
        count_ray_cells(start, ends, self._low_m, self.cell_m, self._pass_count, self._hit_count)

    def dynamic_returns(self, points_map_m: np.ndarray, least: int = 6, ratio: float = 0.1) -> np.ndarray:
        """Return bool [N]: returns in cells with >= `least` passes and <= `ratio` hits per pass."""
        index = np.floor((points_map_m[:, :2] - self._low_m) / self.cell_m).astype(np.int64)
        size = len(self._pass_count)
        inside = np.all((index >= 1) & (index < size - 1), axis=1)
        column, row = np.clip(index, 1, size - 2).T
        ended = np.zeros(len(index), dtype=np.int64)
        for dv in (-1, 0, 1):
            for du in (-1, 0, 1):
                ended = np.maximum(ended, self._hit_count[row + dv, column + du])
        passed = self._pass_count[row, column].astype(np.int64)
        return inside & (passed >= least) & (ended <= ratio * passed)


@kernel
def count_ray_cells(
    start_m: np.ndarray,  # float64 [2]
    ends_m: np.ndarray,  # float64 [N, 2]
    low_m: float,
    cell_m: float,
    passed: np.ndarray,  # uint16 [rows, columns]
    ended: np.ndarray,  # uint16 [rows, columns]
) -> None:
    """Count the cells that each beam crosses, except the last two, and the cell in which it ends."""
    rows, columns = passed.shape
    for k in range(ends_m.shape[0]):
        dx, dy = ends_m[k, 0] - start_m[0], ends_m[k, 1] - start_m[1]
        length = np.hypot(dx, dy)
        if not 0.0 < length < cell_m * (rows + columns):  # non-finite or absurd lengths would not terminate
            continue
        steps = int(length / (0.5 * cell_m)) - 4
        last_i, last_j = -1, -1
        for step in range(max(steps, 0)):
            f = step * 0.5 * cell_m / length
            j = int(np.floor((start_m[0] + f * dx - low_m) / cell_m))
            i = int(np.floor((start_m[1] + f * dy - low_m) / cell_m))
            if (i != last_i or j != last_j) and 0 <= i < rows and 0 <= j < columns:
                if passed[i, j] < 65535:
                    passed[i, j] += 1
                last_i, last_j = i, j
        j = int(np.floor((ends_m[k, 0] - low_m) / cell_m))
        i = int(np.floor((ends_m[k, 1] - low_m) / cell_m))
        if 0 <= i < rows and 0 <= j < columns and ended[i, j] < 65535:
            ended[i, j] += 1
