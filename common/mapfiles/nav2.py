"""What the camera saw as an occupancy layer beside the lidar's: tables, chairs' seats, shelves, low boxes."""

from __future__ import annotations

import numpy as np

OCCUPIED, FREE, UNKNOWN = 100, 0, -1
_FLOOR_M = 0.06  # around z = 0
_LEAST_POINTS = 3  # in a cell, of those the surface is sampled with: one is a stray
_LEAST_HEIGHT_M = 0.04  # between the lowest and the highest of them


def camera_layer(
    points_map_m: np.ndarray,  # float64 [N, 3] of the surface
    origin_m: tuple[float, float],  # lower left corner of cell (0, 0)
    shape: tuple[int, int],  # rows, columns
    resolution_m: float,
    low_m: float,
    high_m: float,
) -> np.ndarray:
    """int8 [rows, columns]: 100 where something stands between `low_m` and `high_m` above the floor, 0 where
    floor is seen and nothing stands, -1 elsewhere."""
    column, row = (
        np.floor((points_map_m[:, axis] - origin_m[axis]) / resolution_m).astype(int) for axis in (0, 1)
    )
    z = points_map_m[:, 2]
    inside = (row >= 0) & (column >= 0) & (row < shape[0]) & (column < shape[1])
    cell = row * shape[1] + column
    size = shape[0] * shape[1]
    standing = inside & (z >= low_m) & (z <= high_m)
    count = np.bincount(cell[standing], minlength=size)
    top, bottom = np.full(size, -np.inf), np.full(size, np.inf)
    np.maximum.at(top, cell[standing], z[standing])
    np.minimum.at(bottom, cell[standing], z[standing])
    floor = np.bincount(cell[inside & (np.abs(z) <= _FLOOR_M)], minlength=size)
    out = np.full(size, UNKNOWN, np.int8)
    out[floor > 0] = FREE
    with np.errstate(invalid="ignore"):
        out[(count >= _LEAST_POINTS) & ((top - bottom >= _LEAST_HEIGHT_M) | (floor == 0))] = OCCUPIED
    return out.reshape(shape)


def combined(lidar: np.ndarray, camera: np.ndarray, occupied: int, free: int) -> np.ndarray:
    """int8: the lidar's cells (percent, -1 unknown) and, where it has no wall, what the camera saw there."""
    out = lidar.copy()
    open_to_camera = lidar < occupied
    out[open_to_camera & (camera == OCCUPIED)] = OCCUPIED
    out[(lidar == UNKNOWN) & (camera == FREE)] = FREE
    doubtful = (lidar > free) & (lidar < occupied) & (camera == FREE)
    out[doubtful] = FREE
    return out


def grid_around(points_map_m: np.ndarray, resolution_m: float) -> tuple[tuple[float, float], tuple[int, int]]:
    """(origin, shape) of a grid that covers points [N, 3] and a rim, for a map without a lidar's."""
    low = (np.floor(points_map_m[:, :2].min(axis=0) / resolution_m) - 1.0) * resolution_m
    cells = np.floor((points_map_m[:, :2].max(axis=0) - low) / resolution_m).astype(int) + 2
    return (float(low[0]), float(low[1])), (int(cells[1]), int(cells[0]))
