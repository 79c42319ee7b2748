"""The local map for scan matching: surface elements, free space and a likelihood field on one grid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_kernels import (
    add_returns,
    cast_rays,
    compute_surfels,
    refresh,
)

BLOCK = 64  # grids grow in multiples of this many cells
MARGIN = 8  # cells kept around observed space


@dataclass(frozen=True)
class MatchTables:
    """Lookup tables of scan matching; the arrays may be shared with the map (not copied)."""

    nearest: np.ndarray  # int32 [H, W], index of the nearest surface element within reach, -1 = none
    field: np.ndarray  # uint8 [H, W], likelihood of a return, for searches
    means: np.ndarray  # float64 [S, 2]
    omegas: np.ndarray  # float64 [S, 3], information xx, xy, yy
    views: np.ndarray  # float64 [S, 2], mean unit direction towards the lidar
    misses: np.ndarray  # uint8 [H, W], beams that crossed a cell
    row0: int
    col0: int
    cell_m: float


class SurfelMap:
    """A growing grid map in its own frame: rows along y, columns along x, origin at a corner of (0, 0)."""

    # Arrays with a row for each surface element; set by `_reserve_surfels`.
    moments: np.ndarray  # float64 [N, 6]
    views: np.ndarray  # float64 [N, 2]
    cells: np.ndarray  # int32 [N, 2]
    means: np.ndarray  # float64 [N, 2]
    omegas: np.ndarray  # float64 [N, 3]
    table_means: np.ndarray  # float64 [N, 2]

    def __init__(self, settings: LidarSlamSettings) -> None:
        self.settings = settings
        self.cell_m = settings.cell_m
        self.row0 = self.col0 = -BLOCK
        shape = (2 * BLOCK, 2 * BLOCK)
        self.cell_id = np.full(shape, -1, dtype=np.int32)
        self.nearest = np.full(shape, -1, dtype=np.int32)
        self.touched = np.full(shape, -1, dtype=np.int32)
        self.field = np.zeros(shape, dtype=np.uint8)
        self.hits = np.zeros(shape, dtype=np.uint8)
        self.misses = np.zeros(shape, dtype=np.uint8)
        self.count = 0
        self.scans = 0
        self._reserve_surfels(1024)

    def _reserve_surfels(self, capacity: int) -> None:
        for name, width, dtype in (
            ("moments", 6, np.float64),
            ("views", 2, np.float64),
            ("cells", 2, np.int32),
            ("means", 2, np.float64),
            ("omegas", 3, np.float64),
            ("table_means", 2, np.float64),
        ):
            grown = np.zeros((capacity, width), dtype=dtype)
            if self.count:
                grown[: self.count] = getattr(self, name)[: self.count]
            setattr(self, name, grown)

    def cover(self, points: np.ndarray) -> None:
        """Grow the grids until the points (float64 [N, 2], N > 0) are inside, with a margin."""
        top, bottom, left, right = _growth(points, self.cell_m, self.row0, self.col0, *self.cell_id.shape)
        if top or bottom or left or right:
            pad = ((top, bottom), (left, right))
            for name, fill in (
                ("cell_id", -1),
                ("nearest", -1),
                ("touched", -1),
                ("field", 0),
                ("hits", 0),
                ("misses", 0),
            ):
                setattr(self, name, np.pad(getattr(self, name), pad, constant_values=fill))
            self.row0 -= top
            self.col0 -= left

    def insert(
        self,
        points: np.ndarray,  # float64 [M, 2] in this map's frame
        tangents: np.ndarray,  # float64 [M, 2]
        spacing_m: np.ndarray,  # float64 [M]
        origin: np.ndarray,  # float64 [2], position of the lidar
        surface: np.ndarray,  # bool [M], returns inserted as surface
        free: np.ndarray,  # bool [M], returns whose beams clear cells
        matchable: bool = True,  # False: postpone the match tables, see make_matchable()
    ) -> None:
        """Insert one scan: add its returns as surface, and count misses along its beams."""
        if len(points) == 0:
            return
        self.cover(points)
        self.cover(origin[None])
        if self.count + len(points) > len(self.moments):
            self._reserve_surfels(max(2 * len(self.moments), self.count + len(points)))
        changed = np.empty(len(points), dtype=np.int32)
        self.count, n = add_returns(
            points,
            tangents,
            spacing_m,
            surface,
            origin,
            self.scans,
            self.cell_id,
            self.hits,
            self.misses,
            self.touched,
            self.moments,
            self.views,
            self.cells,
            self.table_means,
            self.count,
            self.row0,
            self.col0,
            self.cell_m,
            changed,
        )
        cast_rays(
            points,
            free,
            origin,
            self.scans,
            self.hits,
            self.misses,
            self.touched,
            self.row0,
            self.col0,
            self.cell_m,
        )
        if matchable:
            self._refresh(changed[:n])
        self.scans += 1

    def make_matchable(self) -> None:
        """Compute surface elements and match tables that were postponed by `insert(..., matchable=False)`."""
        self._refresh(np.arange(self.count, dtype=np.int32))

    def _refresh(self, changed: np.ndarray) -> None:
        s = self.settings
        refresh(
            changed,
            self.cell_id,
            self.nearest,
            self.field,
            self.moments,
            self.cells,
            self.means,
            self.omegas,
            self.table_means,
            self.row0,
            self.col0,
            self.cell_m,
            s.reach_cells,
            s.range_sigma_m,
            s.map_sigma_m,
        )

    def surface_elements(self) -> tuple[np.ndarray, np.ndarray]:
        """Return means float64 [S, 2] and information float64 [S, 3] of all cells with returns."""
        s, n = self.settings, self.count
        compute_surfels(
            self.cell_id, self.moments, self.cells[:n], self.row0, self.col0, s.range_sigma_m, s.map_sigma_m,
            self.means, self.omegas,
        )  # fmt: skip
        return self.means[:n], self.omegas[:n]

    def tables(self) -> MatchTables:
        """Return the live tables of this map, not a copy."""
        return MatchTables(
            self.nearest,
            self.field,
            self.means,
            self.omegas,
            self.views,
            self.misses,
            self.row0,
            self.col0,
            self.cell_m,
        )


@kernel
def _growth(
    points: np.ndarray, cell_m: float, row0: int, col0: int, rows: int, cols: int
) -> tuple[int, int, int, int]:
    """Return the cells to add at low rows, high rows, low columns and high columns, in whole blocks."""
    x_low = x_high = points[0, 0]
    y_low = y_high = points[0, 1]
    for i in range(1, points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        x_low, x_high, y_low, y_high = min(x_low, x), max(x_high, x), min(y_low, y), max(y_high, y)
    top = row0 - (math.floor(y_low / cell_m) - MARGIN)
    bottom = math.floor(y_high / cell_m) + MARGIN + 1 - row0 - rows
    left = col0 - (math.floor(x_low / cell_m) - MARGIN)
    right = math.floor(x_high / cell_m) + MARGIN + 1 - col0 - cols
    return (
        -(-max(top, 0) // BLOCK) * BLOCK,
        -(-max(bottom, 0) // BLOCK) * BLOCK,
        -(-max(left, 0) // BLOCK) * BLOCK,
        -(-max(right, 0) // BLOCK) * BLOCK,
    )
