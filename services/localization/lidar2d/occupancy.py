"""Occupancy grids from the hits and misses of all submaps, and their files for nav2."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2

HIT_LOG_ODDS = 1.5  # one hit outweighs three misses, because beams pass walls at grazing angles
MISS_LOG_ODDS = -0.5
OCCUPIED, FREE, UNKNOWN = 65, 25, -1  # percent; limits of nav2 for occupied and free


@dataclass(frozen=True)
class OccupancyGrid:
    """Occupancy in percent, -1 = unknown, as in nav_msgs/OccupancyGrid; row 0 has the lowest y."""

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
    """Add hits and misses of a submap to the map grid, from the submap cell at each map cell's centre."""
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
    """Hits and misses of one submap, with its pose."""

    hits: np.ndarray  # uint8 [h, w]
    misses: np.ndarray  # uint8 [h, w]
    row0: int
    col0: int
    cell_m: float
    pose_map_submap: np.ndarray  # float64 [3]

    def corners(self) -> np.ndarray:
        """Return the corners of the observed rectangle in the map frame, float64 [4, 2]."""
        seen = (self.hits > 0) | (self.misses > 0)
        rows, cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        if len(rows) == 0:
            return se2.transform(self.pose_map_submap, np.zeros((4, 2)))
        x = np.array([cols[0], cols[-1] + 1, cols[-1] + 1, cols[0]]) + self.col0
        y = np.array([rows[0], rows[0], rows[-1] + 1, rows[-1] + 1]) + self.row0
        return se2.transform(self.pose_map_submap, np.column_stack([x, y]) * self.cell_m)


def render_occupancy(grids: list[CountGrid], resolution_m: float) -> OccupancyGrid:
    """Return one occupancy grid of all submaps.

    The origin is a multiple of 64 cells, so that cell boundaries do not change when the grid grows.
    """
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


def save_nav2(grid: OccupancyGrid, folder: Path, name: str = "map") -> None:
    """Write `NAME.pgm` and `NAME.yaml` for the map server of nav2, and `NAME.png` as a preview."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    flipped = grid.values[::-1]
    height, width = flipped.shape
    image = np.full((height, width), 205, dtype=np.uint8)
    image[(flipped >= 0) & (flipped <= FREE)] = 254
    image[flipped >= OCCUPIED] = 0
    header = f"P5\n{width} {height}\n255\n".encode()
    (folder / f"{name}.pgm").write_bytes(header + image.tobytes())
    (folder / f"{name}.yaml").write_text(
        f"image: {name}.pgm\nmode: trinary\nresolution: {grid.resolution_m}\n"
        f"origin: [{grid.origin_x_m:.6f}, {grid.origin_y_m:.6f}, 0.0]\nnegate: 0\n"
        # Pixel 205 (unknown) is (255 - 205) / 255 = 0.1961 and must not be read as free.
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    known = np.argwhere(flipped >= 0)
    shown = np.where(flipped < 0, 205, 255 - (flipped.astype(np.int16) * 255) // 100).astype(np.uint8)
    if len(known):
        (r0, c0), (r1, c1) = known.min(axis=0), known.max(axis=0) + 1
        shown = shown[r0:r1, c0:c1]
    if not cv2.imwrite(str(folder / f"{name}.png"), shown):
        raise ValueError(f"{folder / name}.png cannot be written")
