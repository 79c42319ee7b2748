"""Real-time correlative scan matching (Olson 2009): all poses of a window against the likelihood field."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d.surfel_map import MatchTables


@kernel
def correlate(
    points: np.ndarray,  # float64 [K, 2] body frame
    pose: np.ndarray,  # float64 [3] centre of the window
    field: np.ndarray,  # uint8 [H, W]
    row0: int,
    col0: int,
    cell_m: float,
    steps_xy: int,
    stride: int,  # window of +-steps_xy * stride cells
    steps_yaw: int,
    step_yaw_rad: float,
    scores: np.ndarray,  # out float32 [2 steps_yaw + 1, 2 steps_xy + 1, 2 steps_xy + 1], mean likelihood
) -> None:
    """Write the mean likelihood (0 .. 1) of every pose in a window around `pose` to `scores` (Olson 2009)."""
    n = points.shape[0]
    rows, cols = np.empty(n, dtype=np.int32), np.empty(n, dtype=np.int32)
    for a in range(2 * steps_yaw + 1):
        yaw = pose[2] + (a - steps_yaw) * step_yaw_rad
        c, s = math.cos(yaw), math.sin(yaw)
        for i in range(n):
            rows[i] = math.floor((pose[1] + s * points[i, 0] + c * points[i, 1]) / cell_m) - row0
            cols[i] = math.floor((pose[0] + c * points[i, 0] - s * points[i, 1]) / cell_m) - col0
        for iy in range(2 * steps_xy + 1):
            dr = (iy - steps_xy) * stride
            for ix in range(2 * steps_xy + 1):
                dc = (ix - steps_xy) * stride
                total = 0
                for i in range(n):
                    r, q = rows[i] + dr, cols[i] + dc
                    if r >= 0 and q >= 0 and r < field.shape[0] and q < field.shape[1]:
                        total += field[r, q]
                scores[a, iy, ix] = total / (255.0 * n)


def search(
    points: np.ndarray,
    centre_pose: np.ndarray,
    tables: MatchTables,
    window_m: float,
    window_rad: float,
    prior_weight: float = 0.0,
    candidates: int = 3,
    step_yaw_rad: float = math.radians(1.5),
) -> list[tuple[float, np.ndarray]]:
    """Return the best distinct poses of a window as (score, pose [3] of the body in the frame of the map).

    Poses are ranked by mean likelihood minus a penalty that grows with the square of the distance from the
    centre of the window, to `prior_weight` at the border, in each of x, y and yaw.
    """
    stride = 2
    steps_xy = max(1, math.ceil(window_m / (stride * tables.cell_m)))
    steps_yaw = max(1, math.ceil(window_rad / step_yaw_rad))
    subset = points[:: max(1, len(points) // 100)]
    scores = np.empty((2 * steps_yaw + 1, 2 * steps_xy + 1, 2 * steps_xy + 1), dtype=np.float32)
    correlate(
        subset,
        centre_pose,
        tables.field,
        tables.row0,
        tables.col0,
        tables.cell_m,
        steps_xy,
        stride,
        steps_yaw,
        step_yaw_rad,
        scores,
    )
    grid_xy = np.linspace(-1.0, 1.0, 2 * steps_xy + 1) ** 2
    grid_yaw = np.linspace(-1.0, 1.0, 2 * steps_yaw + 1) ** 2
    ranked = scores - prior_weight * (grid_yaw[:, None, None] + grid_xy[:, None] + grid_xy)
    best = []
    for _ in range(candidates):
        a, iy, ix = np.unravel_index(int(np.argmax(ranked)), ranked.shape)
        pose = centre_pose + np.array(
            [
                (ix - steps_xy) * stride * tables.cell_m,
                (iy - steps_xy) * stride * tables.cell_m,
                (a - steps_yaw) * step_yaw_rad,
            ]
        )
        best.append((float(scores[a, iy, ix]), pose))
        ranked[max(a - 2, 0) : a + 3, max(iy - 1, 0) : iy + 2, max(ix - 1, 0) : ix + 2] = -np.inf
        if not np.isfinite(ranked).any():
            break
    return best
