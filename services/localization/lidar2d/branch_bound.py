"""Branch-and-bound scan matching (Hess et al. 2016, section V-B): the exact best pose in a large window."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d.table_kernels import FIELD_SIGMA_M

SAME_POSE_CELLS = 3  # leaves within this distance count as the same pose
FIELD_CELL_M = 0.1  # cell of the field of `search_pyramid`, half a search cell
LEVELS = 6  # a cell of the coarsest level covers 2^5 x 2^5 search cells


@dataclass(frozen=True)
class SearchPyramid:
    """Precomputed grids for branch and bound.

    A cell of level h contains the maximum likelihood of the 2^h x 2^h search cells that start at this cell.
    """

    levels: np.ndarray  # uint8 [LEVELS, H, W], padded by 2^(LEVELS - 1) on all sides
    row0: int  # search cell of the first row of the padded arrays
    col0: int
    cell_m: float


@kernel
def _fill(field: np.ndarray, shift_r: int, shift_c: int, levels: np.ndarray) -> None:
    """Compute all levels of the pyramid from the likelihood field, shifted by whole field cells."""
    for r in range(field.shape[0]):
        for c in range(field.shape[1]):
            rr, cc = (r + shift_r) >> 1, (c + shift_c) >> 1
            if field[r, c] > levels[0, rr, cc]:
                levels[0, rr, cc] = field[r, c]
    rows, cols = levels.shape[1], levels.shape[2]
    for h in range(1, levels.shape[0]):
        d = 1 << (h - 1)
        for r in range(rows):
            r2 = min(r + d, rows - 1)
            for c in range(cols):
                c2 = min(c + d, cols - 1)
                levels[h, r, c] = max(
                    max(levels[h - 1, r, c], levels[h - 1, r2, c]),
                    max(levels[h - 1, r, c2], levels[h - 1, r2, c2]),
                )


def build_pyramid(field: np.ndarray, row0: int, col0: int, cell_m: float) -> SearchPyramid:
    """Return the search pyramid of a likelihood field uint8 [H, W] whose first cell is (row0, col0).

    Search cells are twice as large as the cells of the field.
    """
    pad = 1 << (LEVELS - 1)
    r0, c0 = row0 >> 1, col0 >> 1
    rows = ((row0 + field.shape[0]) >> 1) - r0 + 1
    cols = ((col0 + field.shape[1]) >> 1) - c0 + 1
    levels = np.zeros((LEVELS, rows + 2 * pad, cols + 2 * pad), dtype=np.uint8)
    _fill(field, row0 - 2 * r0 + 2 * pad, col0 - 2 * c0 + 2 * pad, levels)
    return SearchPyramid(levels, r0 - pad, c0 - pad, 2.0 * cell_m)


@kernel
def _fill_field(
    means: np.ndarray, row0: int, col0: int, cell_m: float, sigma_m: float, field: np.ndarray
) -> None:
    """Write to `field` the largest likelihood that a surface element causes anywhere in each cell."""
    for i in range(means.shape[0]):
        row, col = math.floor(means[i, 1] / cell_m), math.floor(means[i, 0] / cell_m)
        for r in range(row - 1, row + 2):
            for c in range(col - 1, col + 2):
                if r < row0 or c < col0 or r >= row0 + field.shape[0] or c >= col0 + field.shape[1]:
                    continue
                dx = max(c * cell_m - means[i, 0], means[i, 0] - (c + 1) * cell_m, 0.0)
                dy = max(r * cell_m - means[i, 1], means[i, 1] - (r + 1) * cell_m, 0.0)
                value = np.uint8(255.0 * math.exp(-0.5 * (dx * dx + dy * dy) / (sigma_m * sigma_m)))
                if value > field[r - row0, c - col0]:
                    field[r - row0, c - col0] = value


def search_pyramid(means: np.ndarray) -> SearchPyramid:
    """Return the search pyramid, of 0.2 m per cell, of surface elements with these means float [S, 2]."""
    means = means.astype(np.float64)
    if len(means) == 0:
        return build_pyramid(np.zeros((2, 2), dtype=np.uint8), 0, 0, FIELD_CELL_M)
    low = np.floor(means.min(axis=0) / FIELD_CELL_M).astype(np.int64) - 1
    high = np.floor(means.max(axis=0) / FIELD_CELL_M).astype(np.int64) + 2
    field = np.zeros((int(high[1] - low[1]), int(high[0] - low[0])), dtype=np.uint8)
    _fill_field(means, int(low[1]), int(low[0]), FIELD_CELL_M, FIELD_SIGMA_M, field)
    return build_pyramid(field, int(low[1]), int(low[0]), FIELD_CELL_M)


@kernel
def _score(level: np.ndarray, rows: np.ndarray, cols: np.ndarray, dr: int, dc: int) -> float:
    """Return the mean likelihood (0 .. 1) of the returns in cells (rows + dr, cols + dc) of a level."""
    total = 0
    for i in range(rows.shape[0]):
        r, c = rows[i] + dr, cols[i] + dc
        if r >= 0 and c >= 0 and r < level.shape[0] and c < level.shape[1]:
            total += level[r, c]
    return total / (255.0 * rows.shape[0])


@kernel
def _row_for(found: np.ndarray, count: int, score: float, yaw: int, dr: int, dc: int, near_yaw: int) -> int:
    """Return the row of the result table to which a leaf is written, -1 if a better leaf is nearby.

    It is the row of a worse leaf nearby, else the next free row. Without this rule, the many poses around the
    best pose would fill the table.
    """
    for i in range(count):
        if (
            abs(found[i, 2] - dr) <= SAME_POSE_CELLS
            and abs(found[i, 3] - dc) <= SAME_POSE_CELLS
            and abs(found[i, 1] - yaw) <= near_yaw
        ):
            return i if score > found[i, 0] else -1
    return count


@kernel
def _make_room(found: np.ndarray, best: float, keep: float) -> tuple[float, int]:
    """Remove leaves with a score below `keep` * `best`; increase `keep` until a quarter of the table is free.

    The best leaf is never removed. Returns the new `keep` and the number of leaves left.
    """
    count = found.shape[0]
    while 4 * count > 3 * found.shape[0]:
        keep += 0.2 * (1.0 - keep)
        kept = 0
        for i in range(count):
            if found[i, 0] >= keep * best:
                found[kept] = found[i]
                kept += 1
        if keep > 0.9999:
            kept = min(kept, found.shape[0] // 2)  # all scores are equal: keep an arbitrary half
        count = kept
    return keep, count


@kernel
def _search(
    levels: np.ndarray,  # uint8 [L, H, W]
    rows: np.ndarray,  # int32 [A, K] cells of the returns at each yaw, window centre
    cols: np.ndarray,
    steps: int,  # window of +-steps cells
    min_score: float,
    keep: float,  # leaves with a score above keep * best are reported
    near_yaw: int,  # leaves within this many yaw steps count as the same pose
    found: np.ndarray,  # out float64 [M, 4] score, yaw index, dr, dc
) -> tuple[int, int]:
    """Search depth first, best child first; return the number of rows of `found` and of scores computed."""
    top = levels.shape[0] - 1
    width = 1 << top
    n_angles = rows.shape[0]
    side = (2 * steps) // width + 1
    n = n_angles * side * side
    order_score = np.empty(n)
    for a in range(n_angles):
        for iy in range(side):
            for ix in range(side):
                order_score[(a * side + iy) * side + ix] = _score(
                    levels[top], rows[a], cols[a], -steps + iy * width, -steps + ix * width
                )
    order = np.argsort(-order_score)
    best, count, visited = min_score, 0, n
    stack = np.empty((8 * (top + 1) + 8, 5))
    for k in range(n):
        root = order[k]
        if order_score[root] < max(min_score, keep * best):
            break
        a = root // (side * side)
        stack[0, 0], stack[0, 1], stack[0, 2] = order_score[root], top, a
        stack[0, 3], stack[0, 4] = -steps + (root // side) % side * width, -steps + root % side * width
        depth = 1
        while depth > 0:
            depth -= 1
            score, hh, ai = stack[depth, 0], int(stack[depth, 1]), int(stack[depth, 2])
            r0, c0 = int(stack[depth, 3]), int(stack[depth, 4])
            if score < max(min_score, keep * best):
                continue
            if hh == 0:
                if score > best:
                    best = score
                row = _row_for(found, count, score, ai, r0, c0, near_yaw)
                if row == found.shape[0]:
                    keep, count = _make_room(found, best, keep)
                    row = count
                if row >= 0:
                    found[row, 0], found[row, 1], found[row, 2], found[row, 3] = score, ai, r0, c0
                    count = max(count, row + 1)
                continue
            half = 1 << (hh - 1)
            base = depth
            for q in range(4):
                r1, c1 = r0 + (q >> 1) * half, c0 + (q & 1) * half
                if r1 > steps or c1 > steps:
                    continue
                child = _score(levels[hh - 1], rows[ai], cols[ai], r1, c1)
                visited += 1
                if child < max(min_score, keep * best):
                    continue
                j = depth  # insertion keeps the best child on top of the stack
                while j > base and stack[j - 1, 0] > child:
                    stack[j] = stack[j - 1]
                    j -= 1
                stack[j, 0], stack[j, 1], stack[j, 2], stack[j, 3], stack[j, 4] = child, hh - 1, ai, r1, c1
                depth += 1
    return count, visited


def branch_and_bound(
    points: np.ndarray,  # float64 [K, >= 2] body frame
    centre_pose: np.ndarray,  # float64 [3] centre of the window, in the pyramid's frame
    pyramid: SearchPyramid,
    window_m: float,
    window_rad: float,
    min_score: float,
    keep: float = 0.97,
    max_found: int = 512,
    min_step_rad: float = math.radians(0.8),
) -> list[tuple[float, np.ndarray]]:
    """Search a window around `centre_pose`; return distinct (score, pose [3]), best first.

    The score is the mean likelihood (0 .. 1); the pose is of the body in the frame of the pyramid. The list
    contains poses with a score of at least `min_score` and of about `keep` times the best score or more.
    """
    if len(points) == 0:
        return []
    reach = np.percentile(np.hypot(points[:, 0], points[:, 1]), 80)
    step_rad = min(max(pyramid.cell_m / max(reach, 1e-6), min_step_rad), math.radians(3.0))
    half = math.ceil(window_rad / step_rad)
    if window_rad >= math.pi - 1e-6:
        half = math.ceil(math.pi / step_rad)
        step_rad = math.pi / half
    yaws = centre_pose[2] + step_rad * np.arange(-half, half + 1)
    if window_rad >= math.pi - 1e-6:
        yaws = yaws[:-1]
    c, s = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    x = centre_pose[0] + c * points[:, 0] - s * points[:, 1]
    y = centre_pose[1] + s * points[:, 0] + c * points[:, 1]
    rows = np.floor(y / pyramid.cell_m).astype(np.int32) - pyramid.row0
    cols = np.floor(x / pyramid.cell_m).astype(np.int32) - pyramid.col0
    found = np.empty((max_found, 4))
    steps = max(1, math.ceil(window_m / pyramid.cell_m))
    count, _ = _search(
        pyramid.levels, rows, cols, steps, min_score, keep, max(1, round(0.1 / step_rad)), found
    )
    found = found[:count]
    best: list[tuple[float, np.ndarray]] = []
    for score, a, dr, dc in found[np.argsort(-found[:, 0], kind="stable")]:
        pose = np.array(
            [centre_pose[0] + dc * pyramid.cell_m, centre_pose[1] + dr * pyramid.cell_m, yaws[int(a)]]
        )
        near = any(
            math.hypot(pose[0] - o[0], pose[1] - o[1]) < 4 * pyramid.cell_m
            and abs(math.remainder(pose[2] - o[2], 2 * math.pi)) < max(4 * step_rad, 0.1)
            for _, o in best
        )
        if not near and score >= keep * (best[0][0] if best else 0.0):
            best.append((float(score), pose))
    return best
