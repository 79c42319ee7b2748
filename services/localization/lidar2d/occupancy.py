"""Occupancy grids from the hits and misses of submaps, drawn tile by tile, and their files for nav2."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2

OCCUPIED, FREE, UNKNOWN = 65, 25, -1  # percent; limits of nav2 for occupied and free
_MARGIN_CELLS = 64  # the edges of a whole grid are at multiples of this many cells
_BAND_CELLS = 12_000_000  # a whole grid is drawn in bands of rows: 60 MB of sums at a time
# Log odds in half units: a hit is +1.5, a miss -0.5. One hit outweighs three misses, because beams pass walls
# at grazing angles.
HIT, MISS = 3, -1
_LIMIT = 12  # of the sum: log odds of 6


@dataclass(frozen=True)
class OccupancyGrid:
    """Occupancy in percent, -1 = unknown, as in nav_msgs/OccupancyGrid; row 0 has the lowest y."""

    values: np.ndarray  # int8 [H, W]
    origin_x_m: float  # lower left corner of cell (0, 0) in the map frame
    origin_y_m: float
    resolution_m: float


class Counts(Protocol):
    """Hits and misses of the cells of one submap, in the frame of the submap: a `FrozenMap` for example."""

    @property
    def shape(self) -> tuple[int, int]: ...

    @property
    def row0(self) -> int: ...

    @property
    def col0(self) -> int: ...

    @property
    def cell_m(self) -> float: ...

    def counts(self) -> tuple[np.ndarray, np.ndarray]:
        """Return hits and misses, uint8 [h, w] each."""
        ...


@dataclass(frozen=True)
class CountGrid:
    """Hits and misses of a submap as arrays."""

    hits: np.ndarray  # uint8 [h, w]
    misses: np.ndarray  # uint8 [h, w]
    row0: int
    col0: int
    cell_m: float

    @property
    def shape(self) -> tuple[int, int]:
        return self.hits.shape[0], self.hits.shape[1]

    def counts(self) -> tuple[np.ndarray, np.ndarray]:
        """Return hits and misses, uint8 [h, w] each."""
        return self.hits, self.misses


def outline(grid: Counts, pose_map_submap: np.ndarray) -> np.ndarray:
    """Return the corners of a submap in the map frame, float64 [4, 2]."""
    rows, cols = grid.shape
    corners = [[grid.col0 + u * cols, grid.row0 + v * rows] for u in (0, 1) for v in (0, 1)]
    return se2.transform(pose_map_submap, np.array(corners, dtype=np.float64) * grid.cell_m)


@kernel
def add_counts(
    hits: np.ndarray,
    misses: np.ndarray,  # uint8 [h, w] of a submap
    row0: int,
    col0: int,
    cell_m: float,
    pose_submap_map: np.ndarray,  # float64 [3]
    origin_x: float,
    origin_y: float,
    resolution: float,
    low_row: int,
    high_row: int,
    low_col: int,
    high_col: int,
    score: np.ndarray,  # in out int32 [H, W], log odds in half units
    known: np.ndarray,  # in out bool [H, W]
) -> None:
    """Add hits and misses of a submap to a part of the map, from the submap cell at each map cell's centre.

    `origin_x`, `origin_y`: corner of cell (0, 0) of the part. Rows from `low_row` to before `high_row` are
    visited, and columns likewise.
    """
    c, s = math.cos(pose_submap_map[2]), math.sin(pose_submap_map[2])
    for r in range(low_row, high_row):
        y = origin_y + (r + 0.5) * resolution
        for q in range(low_col, high_col):
            x = origin_x + (q + 0.5) * resolution
            i = math.floor((pose_submap_map[1] + s * x + c * y) / cell_m) - row0
            j = math.floor((pose_submap_map[0] + c * x - s * y) / cell_m) - col0
            if 0 <= i < hits.shape[0] and 0 <= j < hits.shape[1]:
                h, m = hits[i, j], misses[i, j]
                if h > 0 or m > 0:
                    score[r, q] += HIT * np.int32(h) + MISS * np.int32(m)
                    known[r, q] = True


_PERCENT = np.round(100.0 / (1.0 + np.exp(-0.5 * np.arange(-_LIMIT, _LIMIT + 1)))).astype(np.int8)


@dataclass(frozen=True)
class TileSum:
    """Sums over the submaps in a rectangular part of the map, to which submaps are added one at a time."""

    row: int  # the cell (0, 0) of the part has this row number in the map
    column: int
    resolution_m: float
    score: np.ndarray  # int32 [H, W], log odds in half units
    known: np.ndarray  # bool [H, W]

    @staticmethod
    def empty(row: int, column: int, shape: tuple[int, int], resolution_m: float) -> TileSum:
        """Create the sums of no submap for `shape` cells, from (row, column) on."""
        return TileSum(
            row, column, resolution_m, np.zeros(shape, dtype=np.int32), np.zeros(shape, dtype=bool)
        )

    def copy(self) -> TileSum:
        """Return a copy."""
        return TileSum(self.row, self.column, self.resolution_m, self.score.copy(), self.known.copy())

    def add(self, grid: Counts, counts: tuple[np.ndarray, np.ndarray], pose_map_submap: np.ndarray) -> int:
        """Add a submap with `counts` (result of `grid.counts()`); return the number of visited cells."""
        box = outline(grid, pose_map_submap) / self.resolution_m
        corner, size = np.array([self.column, self.row]), np.array(self.score.shape[::-1])
        low_col, low_row = np.clip(np.floor(box.min(axis=0)).astype(int) - corner, 0, size).tolist()
        high_col, high_row = np.clip(np.ceil(box.max(axis=0)).astype(int) - corner, 0, size).tolist()
        if low_col >= high_col or low_row >= high_row:
            return 0
        add_counts(
            *counts, grid.row0, grid.col0, grid.cell_m, se2.inverse(pose_map_submap),
            self.column * self.resolution_m, self.row * self.resolution_m, self.resolution_m,
            low_row, high_row, low_col, high_col, self.score, self.known,
        )  # fmt: skip
        return (high_row - low_row) * (high_col - low_col)

    def occupancy(self) -> np.ndarray:
        """Return the occupancy in percent, int8 [H, W], -1 = unknown."""
        percent = _PERCENT[np.clip(self.score, -_LIMIT, _LIMIT) + _LIMIT]
        return np.where(self.known, percent, np.int8(UNKNOWN)).astype(np.int8)


def render_occupancy(
    submaps: Iterable[tuple[Counts, np.ndarray]], resolution_m: float = 0.05
) -> OccupancyGrid:
    """Return the occupancy grid of a whole map: submaps with their poses `pose_map_submap` (float64 [3]).

    Besides the result it needs the sums of one band of rows, and the counts of one submap.
    """
    drawn = list(submaps)
    if not drawn:
        return OccupancyGrid(np.full((1, 1), UNKNOWN, dtype=np.int8), 0.0, 0.0, resolution_m)
    boxes = [outline(grid, pose) / resolution_m for grid, pose in drawn]
    lows, highs = np.array([b.min(axis=0) for b in boxes]), np.array([b.max(axis=0) for b in boxes])
    low = (np.floor(lows.min(axis=0) / _MARGIN_CELLS) * _MARGIN_CELLS).astype(int)
    high = (np.ceil(highs.max(axis=0) / _MARGIN_CELLS) * _MARGIN_CELLS).astype(int)
    cols, rows = (high - low).tolist()
    values = np.full((rows, cols), UNKNOWN, dtype=np.int8)
    height = max(_BAND_CELLS // cols, 1)
    for row in range(0, rows, height):
        first, last = low[1] + row, low[1] + min(row + height, rows)
        band = TileSum.empty(int(first), int(low[0]), (int(last - first), cols), resolution_m)
        for k in np.flatnonzero((lows[:, 1] < last) & (highs[:, 1] > first)).tolist():
            band.add(drawn[k][0], drawn[k][0].counts(), drawn[k][1])
        values[row : row + height] = band.occupancy()
    return OccupancyGrid(values, float(low[0] * resolution_m), float(low[1] * resolution_m), resolution_m)


def save_nav2(grid: OccupancyGrid, folder: Path, name: str = "map") -> None:
    """Write `NAME.pgm` and `NAME.yaml` for the map server of nav2, and `NAME.png` as a preview."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    flipped = grid.values[::-1]
    height, width = flipped.shape
    image = np.full((height, width), 205, dtype=np.uint8)
    image[(flipped >= 0) & (flipped <= FREE)] = 254
    image[flipped >= OCCUPIED] = 0
    with (folder / f"{name}.pgm").open("wb") as file:
        file.write(f"P5\n{width} {height}\n255\n".encode())
        file.write(image.data)
    del image
    (folder / f"{name}.yaml").write_text(
        f"image: {name}.pgm\nmode: trinary\nresolution: {grid.resolution_m}\n"
        f"origin: [{grid.origin_x_m:.6f}, {grid.origin_y_m:.6f}, 0.0]\nnegate: 0\n"
        # Pixel 205 (unknown) is (255 - 205) / 255 = 0.1961 and must not be read as free.
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    known = flipped >= 0
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if len(rows):
        flipped = flipped[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    if not cv2.imwrite(str(folder / f"{name}.png"), _GREY[flipped.astype(np.int16) + 1]):
        raise ValueError(f"{folder / name}.png cannot be written")


# Grey value of the preview for the occupancy -1 .. 100.
_GREY = np.array([205, *(255 - (percent * 255) // 100 for percent in range(101))], dtype=np.uint8)
