"""Occupancy layer from the map surface: tables, seats and low boxes outside the lidar plane."""

from __future__ import annotations

import numpy as np

OCCUPIED, FREE, UNKNOWN = 100, 0, -1
_FLOOR_M = 0.06  # points with |z| up to this are floor
_MIN_POINTS = 3  # surface samples in an occupied cell: fewer are outliers
_MIN_HEIGHT_M = 0.04  # between the lowest and the highest sample of an occupied cell


def camera_layer(
    points_map_m: np.ndarray,  # float64 [N, 3], samples of the surface
    origin_m: tuple[float, float],  # lower left corner of cell (0, 0)
    shape: tuple[int, int],  # rows, columns
    resolution_m: float,
    low_m: float,
    high_m: float,
) -> np.ndarray:
    """Return the occupancy grid of the map surface, int8 [rows, columns].

    100 = occupied: surface between `low_m` and `high_m` above the floor; 0 = free: floor seen; -1 = unknown.
    """
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
        out[(count >= _MIN_POINTS) & ((top - bottom >= _MIN_HEIGHT_M) | (floor == 0))] = OCCUPIED
    return out.reshape(shape)


def combined(lidar: np.ndarray, camera: np.ndarray, occupied: int, free: int) -> np.ndarray:
    """Combine a lidar grid and a camera layer to one occupancy grid, int8 [rows, columns].

    Cells that are occupied in either input are occupied in the result.

    Args:
        lidar: occupancy in percent, -1 = unknown.
        camera: result of `camera_layer`, of the same shape.
        occupied: a lidar cell with at least this percentage is occupied, and not changed.
        free: a lidar cell with at most this percentage is free. Cells between `free` and `occupied`, and
            unknown cells, become free if the camera saw floor.
    """
    out = lidar.copy()
    open_to_camera = lidar < occupied
    out[open_to_camera & (camera == OCCUPIED)] = OCCUPIED
    out[(lidar == UNKNOWN) & (camera == FREE)] = FREE
    doubtful = (lidar > free) & (lidar < occupied) & (camera == FREE)
    out[doubtful] = FREE
    return out


def grid_around(points_map_m: np.ndarray, resolution_m: float) -> tuple[tuple[float, float], tuple[int, int]]:
    """Return (origin x, y in m; rows, columns) of a grid around points [N, 3], with a margin of one cell."""
    low = (np.floor(points_map_m[:, :2].min(axis=0) / resolution_m) - 1.0) * resolution_m
    cells = np.floor((points_map_m[:, :2].max(axis=0) - low) / resolution_m).astype(int) + 2
    return (float(low[0]), float(low[1])), (int(cells[1]), int(cells[0]))
