"""The local map scans are matched to: surface elements, free space and a likelihood field on one grid."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numba import njit

from services.localization.lidar2d.settings import LidarSlamSettings
from services.localization.lidar2d.surfel_kernels import add_returns, cast_rays, elements, refresh, splat

BLOCK = 64  # grids grow in blocks of so many cells
MARGIN = 8


@dataclass(frozen=True)
class MatchTables:
    """What a matcher reads; arrays are shared with the map that made them."""

    nearest: np.ndarray  # int32 [H, W] index of the nearest surface element, -1 = none in reach
    field: np.ndarray  # uint8 [H, W] likelihood of a return, for searches
    means: np.ndarray  # float64 [S, 2]
    omegas: np.ndarray  # float64 [S, 3]
    views: np.ndarray  # float64 [S, 2]
    seen: np.ndarray  # uint8 [H, W] beams that crossed a cell
    row0: int
    col0: int
    cell_m: float


class SurfelMap:
    """A growing grid in its own frame; row is y, column is x, cell (0, 0) starts at the frame's origin."""

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
            ("told", 2, np.float64),
        ):
            grown = np.zeros((capacity, width), dtype=dtype)
            if self.count:
                grown[: self.count] = getattr(self, name)[: self.count]
            setattr(self, name, grown)

    def _cover(self, points: np.ndarray) -> None:
        low = np.floor(points.min(axis=0) / self.cell_m).astype(np.int64) - MARGIN
        high = np.floor(points.max(axis=0) / self.cell_m).astype(np.int64) + MARGIN + 1
        rows, cols = self.cell_id.shape
        grow = (
            max(0, self.row0 - low[1]),
            max(0, high[1] - self.row0 - rows),
            max(0, self.col0 - low[0]),
            max(0, high[0] - self.col0 - cols),
        )
        top, bottom, left, right = (int(-(-g // BLOCK) * BLOCK) for g in grow)
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
        origin: np.ndarray,  # float64 [2] where the lidar was
        surface: np.ndarray,  # bool [M] returns that become surface
        free: np.ndarray,  # bool [M] returns whose beam clears the cells before it
        matchable: bool = True,  # False: put off what only a matcher reads, see make_matchable()
    ) -> None:
        """Add one scan."""
        if len(points) == 0:
            return
        self._cover(np.vstack([points, origin]))
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
            self.told,
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
        """Bring surface elements and tables up to date after scans that were added without."""
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
            self.told,
            self.row0,
            self.col0,
            self.cell_m,
            s.reach_cells,
            s.range_sigma_m,
            s.map_sigma_m,
        )

    def surface_elements(self) -> tuple[np.ndarray, np.ndarray]:
        """Means float64 [S, 2] and information float64 [S, 3] of every cell with a return, now."""
        s, n = self.settings, self.count
        elements(
            self.cell_id, self.moments, self.cells[:n], self.row0, self.col0, s.range_sigma_m, s.map_sigma_m,
            self.means, self.omegas,
        )  # fmt: skip
        return self.means[:n], self.omegas[:n]

    def tables(self) -> MatchTables:
        """The live tables of this map (not a copy)."""
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


@dataclass(frozen=True)
class FrozenMap:
    """A finished local map in little memory: what is needed to match to it, to search it and to draw it."""

    means: np.ndarray  # float32 [S, 2]
    omegas: np.ndarray  # float32 [S, 3]
    views: np.ndarray  # float32 [S, 2]
    packed: bytes  # hits and misses, uint8 [2, H, W], deflated: most of a grid is empty
    shape: tuple[int, int]
    row0: int
    col0: int
    cell_m: float

    def counts(self) -> tuple[np.ndarray, np.ndarray]:
        """Hits and misses, uint8 [H, W] each."""
        hits, misses = np.frombuffer(zlib.decompress(self.packed), dtype=np.uint8).reshape(2, *self.shape)
        return hits, misses

    def tables(self, reach_cells: int) -> MatchTables:
        """Match tables, computed from the surface elements."""
        means, omegas = self.means.astype(np.float64), self.omegas.astype(np.float64)
        nearest = np.full(self.shape, -1, dtype=np.int32)
        field = np.zeros(self.shape, dtype=np.uint8)
        cells = np.floor(means[:, ::-1] / self.cell_m).astype(np.int64)
        _splat_all(nearest, field, means, omegas, cells, self.row0, self.col0, self.cell_m, reach_cells)
        return MatchTables(
            nearest,
            field,
            means,
            omegas,
            self.views.astype(np.float64),
            self.counts()[1],
            self.row0,
            self.col0,
            self.cell_m,
        )


def freeze(surfels: SurfelMap, min_hit_share: float = 0.2) -> FrozenMap:
    """Keep the surface elements that later beams did not contradict, crop the grids to what was seen."""
    n = surfels.count
    means, omegas = surfels.surface_elements()
    rows, cols = surfels.cells[:n, 0] - surfels.row0, surfels.cells[:n, 1] - surfels.col0
    hits = surfels.hits[rows, cols].astype(np.float64)
    alive = hits >= min_hit_share * (hits + surfels.misses[rows, cols])
    seen = (surfels.hits > 0) | (surfels.misses > 0)
    used_rows, used_cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if len(used_rows) == 0:
        raise ValueError("a map without a single return cannot be frozen")
    r0, r1 = max(used_rows[0] - MARGIN, 0), used_rows[-1] + MARGIN + 1
    c0, c1 = max(used_cols[0] - MARGIN, 0), used_cols[-1] + MARGIN + 1
    return FrozenMap(
        means[alive].astype(np.float32),
        omegas[alive].astype(np.float32),
        surfels.views[:n][alive].astype(np.float32),
        zlib.compress(np.stack([surfels.hits[r0:r1, c0:c1], surfels.misses[r0:r1, c0:c1]]).tobytes(), 1),
        surfels.hits[r0:r1, c0:c1].shape,
        int(surfels.row0 + r0),
        int(surfels.col0 + c0),
        surfels.cell_m,
    )


@njit(nogil=True, cache=True, error_model="numpy")
def _splat_all(
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
