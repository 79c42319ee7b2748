"""Ray casting of a spinning lidar against line segments in a uniform grid, and against moving circles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.tools.simulator.office.floor import FloorPlan

CELL_M = 0.5


@dataclass(frozen=True)
class SegmentGrid:
    """Segments, and for each cell of a grid the segments that touch it."""

    segments: np.ndarray  # float64 [S, 4]
    glass: np.ndarray  # bool [S]
    low_m: np.ndarray  # float64 [2], corner of cell (0, 0)
    shape: tuple[int, int]  # cells along x and y
    start: np.ndarray  # int32 [cells + 1], into `index`, for cell ix * shape[1] + iy
    index: np.ndarray  # int32 [entries], segment numbers


def build_grid(floor: FloorPlan) -> SegmentGrid:
    """Sort the segments of a floor into cells of CELL_M."""
    s = floor.segments
    low = np.minimum(s[:, :2].min(axis=0), s[:, 2:].min(axis=0)) - CELL_M
    high = np.maximum(s[:, :2].max(axis=0), s[:, 2:].max(axis=0)) + CELL_M
    nx, ny = (int(v) for v in np.ceil((high - low) / CELL_M))
    # Samples at quarter cells, each as a square of that size: no cell that a segment touches is missed.
    count = (np.hypot(*(s[:, 2:] - s[:, :2]).T) / (CELL_M / 4.0)).astype(np.int64) + 2
    of = np.repeat(np.arange(len(s)), count)
    part = (np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)) / (count[of] - 1)
    points = s[of, :2] + part[:, None] * (s[of, 2:] - s[of, :2])
    corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * CELL_M / 8.0
    cells = ((points[:, None] + corners - low) / CELL_M).astype(np.int64)
    pairs = np.unique((cells[..., 0] * ny + cells[..., 1]) * len(s) + of[:, None])
    start = np.searchsorted(pairs, np.arange(nx * ny + 1) * len(s)).astype(np.int32)
    return SegmentGrid(s, floor.glass, low, (nx, ny), start, (pairs % len(s)).astype(np.int32))


@kernel
def cast_ray(
    x: float, y: float, dx: float, dy: float, range_max: float,
    segments: np.ndarray, glass: np.ndarray, low: np.ndarray, nx: int, ny: int,
    start: np.ndarray, index: np.ndarray,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return range and incidence cosine of the first opaque surface and of glass before it; inf = none.

    Traversal of the grid after Amanatides and Woo (1987).
    """
    ix, iy = int((x - low[0]) / CELL_M), int((y - low[1]) / CELL_M)
    step_x, step_y = 1 if dx > 0 else -1, 1 if dy > 0 else -1
    inf = np.inf
    delta_x = CELL_M / abs(dx) if dx != 0.0 else inf
    delta_y = CELL_M / abs(dy) if dy != 0.0 else inf
    next_x = (low[0] + (ix + (1 if dx > 0 else 0)) * CELL_M - x) / dx if dx != 0.0 else inf
    next_y = (low[1] + (iy + (1 if dy > 0 else 0)) * CELL_M - y) / dy if dy != 0.0 else inf
    hit, cosine, hit_glass, cosine_glass = inf, 1.0, inf, 1.0
    while 0 <= ix < nx and 0 <= iy < ny:
        cell = ix * ny + iy
        for e in range(start[cell], start[cell + 1]):
            k = index[e]
            ax, ay = segments[k, 0] - x, segments[k, 1] - y
            ex, ey = segments[k, 2] - segments[k, 0], segments[k, 3] - segments[k, 1]
            cross = dx * ey - dy * ex
            if cross == 0.0:
                continue
            t = (ax * ey - ay * ex) / cross
            u = (ax * dy - ay * dx) / cross
            if t <= 0.0 or u < 0.0 or u > 1.0:
                continue
            if glass[k]:
                if t < hit_glass:
                    hit_glass, cosine_glass = t, abs(cross) / np.sqrt(ex * ex + ey * ey)
            elif t < hit:
                hit, cosine = t, abs(cross) / np.sqrt(ex * ex + ey * ey)
        leave = min(next_x, next_y)
        if hit <= leave or leave > range_max:
            break
        if next_x < next_y:
            ix += step_x
            next_x += delta_x
        else:
            iy += step_y
            next_y += delta_y
    if hit_glass > hit:
        hit_glass = inf
    return hit, cosine, hit_glass, cosine_glass


@kernel
def cast_revolution(
    knots: np.ndarray, mount_x: float, mount_y: float, angle_min: float, increment: float, range_max: float,
    segments: np.ndarray, glass: np.ndarray, low: np.ndarray, nx: int, ny: int,
    start: np.ndarray, index: np.ndarray, circles: np.ndarray, out: np.ndarray, moving: np.ndarray,
) -> None:  # fmt: skip
    """Cast the beams of one revolution.

    Args:
        knots: float64 [K + 1, 3], poses (x, y, unwrapped yaw) of the body at equal times from the first beam
            to the end of the revolution; between them the motion is linear.
        mount_x, mount_y: lidar in the body frame, in metres.
        angle_min, increment: angles of the beams in the lidar frame, radians.
        range_max: no surface beyond this range is needed, in metres.
        segments, glass, low, nx, ny, start, index: the parts of a SegmentGrid.
        circles: float64 [K, C, 3], x, y and radius of moving circles, at the middle of each interval.
        out: float64 [B, 4], receives the results of `cast_ray`.
        moving: bool [B], receives whether the beam hits a moving circle.
    """
    beams, parts = out.shape[0], knots.shape[0] - 1
    for b in range(beams):
        at = b * parts / beams
        k = int(at)
        f = at - k
        px = knots[k, 0] + f * (knots[k + 1, 0] - knots[k, 0])
        py = knots[k, 1] + f * (knots[k + 1, 1] - knots[k, 1])
        yaw = knots[k, 2] + f * (knots[k + 1, 2] - knots[k, 2])
        c, s = np.cos(yaw), np.sin(yaw)
        x, y = px + c * mount_x - s * mount_y, py + s * mount_x + c * mount_y
        heading = yaw + angle_min + b * increment
        dx, dy = np.cos(heading), np.sin(heading)
        hit, cosine, hit_glass, cosine_glass = cast_ray(
            x, y, dx, dy, range_max, segments, glass, low, nx, ny, start, index
        )
        moving[b] = False
        for i in range(circles.shape[1]):
            tx, ty, radius = circles[k, i, 0] - x, circles[k, i, 1] - y, circles[k, i, 2]
            along = tx * dx + ty * dy
            aside = tx * dy - ty * dx
            if along <= 0.0 or abs(aside) >= radius:
                continue
            t = along - np.sqrt(radius * radius - aside * aside)
            if 0.0 < t < hit:
                hit, cosine, moving[b] = t, np.sqrt(1.0 - (aside / radius) ** 2), True
        if hit_glass > hit:
            hit_glass = np.inf
        out[b, 0], out[b, 1], out[b, 2], out[b, 3] = hit, cosine, hit_glass, cosine_glass
