"""Branch-and-bound scan matching (Hess et al. 2016, section V-B): the exact best pose in a large window."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d.search_pyramid import LEVELS, SearchPyramid

SAME_POSE_CELLS = 3  # leaves within this distance count as the same pose
# The search begins with cells of 2^3 x 2^3 search cells, for 8 yaws at once.
GROUP_LEVEL, GROUP_YAWS = 3, 8


@kernel
def _score(
    level: np.ndarray, rows: np.ndarray, cols: np.ndarray, dr: int, dc: int, min_score: float
) -> float:
    """Return the mean likelihood (0 .. 1) of the returns in cells (rows + dr, cols + dc) of a level.

    Zero if it is below `min_score`, which shows before all returns are read.
    """
    missing, allowed = 0, int(255.0 * rows.shape[0] * (1.0 - min_score)) + 1
    for i in range(rows.shape[0]):
        r, c = rows[i] + dr, cols[i] + dc
        missing += 255
        if r >= 0 and c >= 0 and r < level.shape[0] and c < level.shape[1]:
            missing -= level[r, c]
        if missing > allowed:
            return 0.0
    return 1.0 - missing / (255.0 * rows.shape[0])


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
def _cells(
    points: np.ndarray,  # float64 [K, >= 2]
    centre_pose: np.ndarray,  # float64 [3]
    yaws: np.ndarray,  # float64 [A]
    cell_m: float,
    row0: int,
    col0: int,
    rows: np.ndarray,  # out int32 [A, K]
    cols: np.ndarray,  # out
) -> None:
    """Compute the search cells of the returns at each yaw, at the centre of the window."""
    for a in range(yaws.shape[0]):
        c, s = math.cos(yaws[a]), math.sin(yaws[a])
        for i in range(points.shape[0]):
            x = centre_pose[0] + c * points[i, 0] - s * points[i, 1]
            y = centre_pose[1] + s * points[i, 0] + c * points[i, 1]
            rows[a, i], cols[a, i] = math.floor(y / cell_m) - row0, math.floor(x / cell_m) - col0


@kernel
def _group_yaws(
    rows: np.ndarray,  # int32 [A, K] cells of the returns at each yaw
    cols: np.ndarray,
    first_row: np.ndarray,  # out int32 [G, K], lowest row of each return over the yaws of a group
    first_col: np.ndarray,
    level: np.ndarray,  # out int8 [G, K], level whose cell covers the search cells of all yaws; -1: none
) -> None:
    """Compute the cells of groups of yaws, at which each return reads an upper bound of its likelihood.

    Over the yaws of a group, a return moves by e rows. A cell of level h that starts at the first row covers
    the 2^GROUP_LEVEL rows of a translation and those e rows if 2^h is at least their sum.
    """
    for g in range(first_row.shape[0]):
        a0, a1 = g * GROUP_YAWS, min((g + 1) * GROUP_YAWS, rows.shape[0])
        for i in range(rows.shape[1]):
            r0, r1, c0, c1 = rows[a0, i], rows[a0, i], cols[a0, i], cols[a0, i]
            for a in range(a0 + 1, a1):
                r0, r1 = min(r0, rows[a, i]), max(r1, rows[a, i])
                c0, c1 = min(c0, cols[a, i]), max(c1, cols[a, i])
            needed = (1 << GROUP_LEVEL) + max(r1 - r0, c1 - c0)
            h = GROUP_LEVEL
            while h < LEVELS and (1 << h) < needed:
                h += 1
            first_row[g, i], first_col[g, i], level[g, i] = r0, c0, h if h < LEVELS else -1


@kernel
def _group_score(
    levels: np.ndarray, level: np.ndarray, rows: np.ndarray, cols: np.ndarray, dr: int, dc: int,
    min_score: float,
) -> float:  # fmt: skip
    """Return an upper bound of the score for a group of yaws and the translations from (dr, dc) on.

    Zero if it is below `min_score`, which shows before all returns are read.
    """
    missing, allowed = 0, int(255.0 * rows.shape[0] * (1.0 - min_score)) + 1
    for i in range(rows.shape[0]):
        if level[i] < 0:
            continue
        r, c = rows[i] + dr, cols[i] + dc
        missing += 255
        if r >= 0 and c >= 0 and r < levels.shape[1] and c < levels.shape[2]:
            missing -= levels[level[i], r, c]
        if missing > allowed:
            return 0.0
    return 1.0 - missing / (255.0 * rows.shape[0])


@kernel
def _push(stack: np.ndarray, depth: int, base: int, score: float, h: int, yaw: int, dr: int, dc: int) -> None:
    """Insert a node above row `base` of the stack so that the best one is on top."""
    j = depth
    while j > base and stack[j - 1, 0] > score:
        stack[j] = stack[j - 1]
        j -= 1
    stack[j, 0], stack[j, 1], stack[j, 2], stack[j, 3], stack[j, 4] = score, h, yaw, dr, dc


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
    width = 1 << GROUP_LEVEL
    groups = (rows.shape[0] + GROUP_YAWS - 1) // GROUP_YAWS
    first_row = np.empty((groups, rows.shape[1]), dtype=np.int32)
    first_col = np.empty((groups, rows.shape[1]), dtype=np.int32)
    level = np.empty((groups, rows.shape[1]), dtype=np.int8)
    _group_yaws(rows, cols, first_row, first_col, level)
    side = (2 * steps) // width + 1
    n = groups * side * side
    order_score = np.empty(n)
    for g in range(groups):
        for iy in range(side):
            for ix in range(side):
                order_score[(g * side + iy) * side + ix] = _group_score(
                    levels, level[g], first_row[g], first_col[g], -steps + iy * width, -steps + ix * width,
                    min_score,
                )  # fmt: skip
    order = np.argsort(-order_score)
    best, count, visited = min_score, 0, n
    stack = np.empty((GROUP_YAWS + 4 * GROUP_LEVEL + 4, 5))
    for k in range(n):
        root = order[k]
        if order_score[root] < max(min_score, keep * best):
            break
        dr, dc = -steps + (root // side) % side * width, -steps + root % side * width
        g, depth = root // (side * side), 0
        for a in range(g * GROUP_YAWS, min((g + 1) * GROUP_YAWS, rows.shape[0])):
            limit = max(min_score, keep * best)
            score = _score(levels[GROUP_LEVEL], rows[a], cols[a], dr, dc, limit)
            visited += 1
            if score >= limit:
                _push(stack, depth, 0, score, GROUP_LEVEL, a, dr, dc)
                depth += 1
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
                limit = max(min_score, keep * best)
                child = _score(levels[hh - 1], rows[ai], cols[ai], r1, c1, limit)
                visited += 1
                if child >= limit:
                    _push(stack, depth, base, child, hh - 1, ai, r1, c1)
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
    rows = np.empty((len(yaws), len(points)), dtype=np.int32)
    cols = np.empty((len(yaws), len(points)), dtype=np.int32)
    _cells(points, centre_pose, yaws, pyramid.cell_m, pyramid.row0, pyramid.col0, rows, cols)
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
