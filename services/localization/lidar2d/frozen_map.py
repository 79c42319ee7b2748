"""A finished local map in compact form, from which match tables are computed when they are needed."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d.surfel_map import MARGIN, MatchTables, SurfelMap
from beamsplat.services.localization.lidar2d.table_kernels import nearest_all, splat_all


@dataclass(frozen=True)
class FrozenMap:
    """A finished local map in compact form, for scan matching, search and rendering."""

    means: np.ndarray  # float32 [S, 2]
    omegas: np.ndarray  # float32 [S, 3]
    views: np.ndarray  # float32 [S, 2]
    packed: bytes  # hits and misses uint8 [2, H, W], compressed with zlib, because most cells are empty
    shape: tuple[int, int]
    row0: int
    col0: int
    cell_m: float

    def counts(self) -> tuple[np.ndarray, np.ndarray]:
        """Return hits and misses, uint8 [H, W] each."""
        size = 2 * self.shape[0] * self.shape[1]
        cells = zlib.decompressobj().decompress(self.packed, size + 1)  # bounded: the file may be hostile
        hits, misses = np.frombuffer(cells, dtype=np.uint8).reshape(2, *self.shape)
        return hits, misses

    def tables(self, reach_cells: int, for_search: bool = True) -> MatchTables:
        """Return match tables computed from the surface elements.

        The likelihood field is computed only with `for_search`.
        """
        means, omegas = self.means.astype(np.float64), self.omegas.astype(np.float64)
        nearest = np.full(self.shape, -1, dtype=np.int32)
        field = np.zeros(self.shape, dtype=np.uint8)
        cells = np.floor(means[:, ::-1] / self.cell_m).astype(np.int64)
        if for_search:
            splat_all(nearest, field, means, omegas, cells, self.row0, self.col0, self.cell_m, reach_cells)
        else:
            nearest_all(nearest, means, cells, self.row0, self.col0, self.cell_m, reach_cells)
        return MatchTables(
            nearest,
            field,
            means,
            omegas,
            self.views.astype(np.float64),
            self.counts()[1].copy(),  # without the hits, which share its memory
            self.row0,
            self.col0,
            self.cell_m,
        )


def freeze(surfels: SurfelMap, counts_of: FrozenMap | None = None, min_hit_ratio: float = 0.2) -> FrozenMap:
    """Return the compact form of a map: grids cropped to observed space, without refuted surfels.

    A surfel is refuted if later beams passed through it: its ratio of hits is below `min_hit_ratio`. With
    `counts_of`, the hit and miss counts are copied from this older map of the same scans.
    """
    n = surfels.count
    means, omegas = surfels.surface_elements()
    rows, cols = surfels.cells[:n, 0] - surfels.row0, surfels.cells[:n, 1] - surfels.col0
    hits = surfels.hits[rows, cols].astype(np.float64)
    if counts_of is None:
        grid = _Counts.of(surfels)
        misses, inside = surfels.misses[rows, cols], np.ones(n, dtype=bool)
    else:
        grid = _Counts(counts_of.packed, counts_of.shape, counts_of.row0, counts_of.col0)
        rows, cols = surfels.cells[:n, 0] - grid.row0, surfels.cells[:n, 1] - grid.col0
        inside = (rows >= 0) & (cols >= 0) & (rows < grid.shape[0]) & (cols < grid.shape[1])
        misses = np.zeros(n, dtype=np.uint8)
        misses[inside] = counts_of.counts()[1][rows[inside], cols[inside]]
    kept = inside & (hits >= min_hit_ratio * (hits + misses))
    return FrozenMap(
        means[kept].astype(np.float32),
        omegas[kept].astype(np.float32),
        surfels.views[:n][kept].astype(np.float32),
        grid.packed,
        grid.shape,
        grid.row0,
        grid.col0,
        surfels.cell_m,
    )


@dataclass(frozen=True)
class _Counts:
    """Hit and miss counts of a map, cropped and compressed, as stored in a frozen map."""

    packed: bytes
    shape: tuple[int, int]
    row0: int
    col0: int

    @staticmethod
    def of(surfels: SurfelMap) -> _Counts:
        """Crop and compress the counts of a map. Raises ValueError if the map has no return."""
        seen = (surfels.hits > 0) | (surfels.misses > 0)
        used_rows, used_cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        if len(used_rows) == 0:
            raise ValueError("a map without a single return cannot be frozen")
        r0, r1 = max(used_rows[0] - MARGIN, 0), used_rows[-1] + MARGIN + 1
        c0, c1 = max(used_cols[0] - MARGIN, 0), used_cols[-1] + MARGIN + 1
        cropped = np.stack([surfels.hits[r0:r1, c0:c1], surfels.misses[r0:r1, c0:c1]])
        packed = zlib.compress(cropped.tobytes(), 1)
        return _Counts(packed, cropped.shape[1:], int(surfels.row0 + r0), int(surfels.col0 + c0))
