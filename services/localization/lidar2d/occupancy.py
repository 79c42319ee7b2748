"""Occupancy grids from hits and misses of all submaps, and their nav2 files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2

HIT_LOG_ODDS = 1.5  # one return outweighs three beams that pass: walls are often seen at a grazing angle
MISS_LOG_ODDS = -0.5
OCCUPIED, FREE, UNKNOWN = 65, 25, -1  # nav2: percent above which a cell is a wall, below which it is free


@dataclass(frozen=True)
class OccupancyGrid:
    """Row 0 is the lowest y; `values` are percent, -1 = unknown, as in nav_msgs/OccupancyGrid."""

    values: np.ndarray  # int8 [H, W]
    origin_x_m: float  # lower left corner of cell (0, 0) in the map frame
    origin_y_m: float
    resolution_m: float


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
    sum_hits: np.ndarray,
    sum_misses: np.ndarray,  # in out float32 [H, W]
) -> None:
    """Each map cell asks the submap's cell at its centre (so that turning leaves no holes)."""
    c, s = math.cos(pose_submap_map[2]), math.sin(pose_submap_map[2])
    for r in range(low_row, high_row):
        y = origin_y + (r + 0.5) * resolution
        for q in range(low_col, high_col):
            x = origin_x + (q + 0.5) * resolution
            i = math.floor((pose_submap_map[1] + s * x + c * y) / cell_m) - row0
            j = math.floor((pose_submap_map[0] + c * x - s * y) / cell_m) - col0
            if 0 <= i < hits.shape[0] and 0 <= j < hits.shape[1]:
                sum_hits[r, q] += hits[i, j]
                sum_misses[r, q] += misses[i, j]


@dataclass(frozen=True)
class CountGrid:
    """Hits and misses of one submap and where it lies."""

    hits: np.ndarray  # uint8 [h, w]
    misses: np.ndarray  # uint8 [h, w]
    row0: int
    col0: int
    cell_m: float
    pose_map_submap: np.ndarray  # float64 [3]

    def corners(self) -> np.ndarray:
        """Corners of what was seen in the map frame, float64 [4, 2]."""
        seen = (self.hits > 0) | (self.misses > 0)
        rows, cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        if len(rows) == 0:
            return se2.transform(self.pose_map_submap, np.zeros((4, 2)))
        x = np.array([cols[0], cols[-1] + 1, cols[-1] + 1, cols[0]]) + self.col0
        y = np.array([rows[0], rows[0], rows[-1] + 1, rows[-1] + 1]) + self.row0
        return se2.transform(self.pose_map_submap, np.column_stack([x, y]) * self.cell_m)


def render(grids: list[CountGrid], resolution_m: float) -> OccupancyGrid:
    """One grid from all submaps; its origin is a multiple of 64 cells, so that it grows in whole tiles."""
    if not grids:
        return OccupancyGrid(np.full((64, 64), UNKNOWN, dtype=np.int8), 0.0, 0.0, resolution_m)
    boxes = [grid.corners() for grid in grids]
    tile = 64 * resolution_m
    low = np.floor(np.min([b.min(axis=0) for b in boxes], axis=0) / tile) * tile
    high = np.ceil(np.max([b.max(axis=0) for b in boxes], axis=0) / tile) * tile
    cols, rows = (int(v) for v in np.round((high - low) / resolution_m))
    hits, misses = np.zeros((rows, cols), dtype=np.float32), np.zeros((rows, cols), dtype=np.float32)
    for grid, box in zip(grids, boxes):
        first = np.floor((box.min(axis=0) - low) / resolution_m).astype(int)
        last = np.ceil((box.max(axis=0) - low) / resolution_m).astype(int)
        add_counts(
            grid.hits,
            grid.misses,
            grid.row0,
            grid.col0,
            grid.cell_m,
            se2.inverse(grid.pose_map_submap),
            low[0],
            low[1],
            resolution_m,
            max(first[1], 0),
            min(last[1], rows),
            max(first[0], 0),
            min(last[0], cols),
            hits,
            misses,
        )
    log_odds = np.clip(HIT_LOG_ODDS * hits + MISS_LOG_ODDS * misses, -6.0, 6.0)
    percent = np.round(100.0 / (1.0 + np.exp(-log_odds))).astype(np.int8)
    values = np.where((hits > 0) | (misses > 0), percent, np.int8(UNKNOWN)).astype(np.int8)
    return OccupancyGrid(values, float(low[0]), float(low[1]), resolution_m)


def changed_regions(
    old: OccupancyGrid | None, new: OccupancyGrid, tile: int = 64
) -> list[tuple[int, int, int, int]]:
    """Tiles of the new grid (row, column, height, width in cells) that differ from the old one."""
    rows, cols = new.values.shape
    reference = np.full((rows, cols), UNKNOWN, dtype=np.int8)
    if old is not None and old.resolution_m == new.resolution_m:
        dr = round((old.origin_y_m - new.origin_y_m) / new.resolution_m)
        dc = round((old.origin_x_m - new.origin_x_m) / new.resolution_m)
        r0, c0 = max(dr, 0), max(dc, 0)
        r1, c1 = min(dr + old.values.shape[0], rows), min(dc + old.values.shape[1], cols)
        if r1 > r0 and c1 > c0:
            reference[r0:r1, c0:c1] = old.values[r0 - dr : r1 - dr, c0 - dc : c1 - dc]
    regions = []
    for r in range(0, rows, tile):
        for c in range(0, cols, tile):
            window = np.s_[r : r + tile, c : c + tile]
            if not np.array_equal(reference[window], new.values[window]):
                regions.append((r, c, *new.values[window].shape))
    return regions


def save_nav2(grid: OccupancyGrid, folder: Path, name: str = "map") -> None:
    """`map.pgm` + `map.yaml` for nav2's map server and `map.png` to look at."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    flipped = grid.values[::-1]
    image = np.full(flipped.shape, 205, dtype=np.uint8)
    image[(flipped >= 0) & (flipped <= FREE)] = 254
    image[flipped >= OCCUPIED] = 0
    header = f"P5\n{image.shape[1]} {image.shape[0]}\n255\n".encode()
    (folder / f"{name}.pgm").write_bytes(header + image.tobytes())
    (folder / f"{name}.yaml").write_text(
        f"image: {name}.pgm\nmode: trinary\nresolution: {grid.resolution_m}\n"
        f"origin: [{grid.origin_x_m:.6f}, {grid.origin_y_m:.6f}, 0.0]\nnegate: 0\n"
        # Between the three pixel values: 205 is (255 - 205) / 255 = 0.1961, and must not read as free.
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    known = np.argwhere(flipped >= 0)
    shown = np.where(flipped < 0, 205, 255 - (flipped.astype(np.int16) * 255) // 100).astype(np.uint8)
    if len(known):
        (r0, c0), (r1, c1) = known.min(axis=0), known.max(axis=0) + 1
        shown = shown[r0:r1, c0:c1]
    if not cv2.imwrite(str(folder / f"{name}.png"), shown):
        raise ValueError(f"{folder / name}.png could not be written")
