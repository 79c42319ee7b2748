"""Detection of returns on dynamic objects: returns in space that the submap has observed free."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel

MIN_FREE_SCANS = 5  # number of nodes that must have observed a cell as free
CLEARANCE_M = 0.12  # a return closer than this to a surface belongs to it
MAX_MISSES_PER_HIT = 4  # a cell with more beams passing through per hit is not a surface any more
MAX_OBJECT_WIDTH_M = 1.2  # objects up to this width are static or dynamic as a whole
MIN_DYNAMIC_RATIO = 0.25  # fraction of an object's returns that must be dynamic to mark all of it


@kernel
def contradicts_free_space(
    points: np.ndarray,  # float64 [M, 2] body frame
    pose: np.ndarray,  # float64 [3] pose_map_body
    nearest: np.ndarray,
    means: np.ndarray,
    hits: np.ndarray,
    misses: np.ndarray,  # uint8 [H, W]
    row0: int,
    col0: int,
    cell_m: float,
    out: np.ndarray,  # out bool [M]
) -> None:
    """Write to `out` which returns contradict observed free space.

    A return is marked if its cell and all neighbours were observed free by at least MIN_FREE_SCANS nodes and
    were rarely hit, and if no surface is within CLEARANCE_M. A surface that later beams have passed through
    is ignored.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(points.shape[0]):
        out[i] = False
        x, y = pose[0] + c * points[i, 0] - s * points[i, 1], pose[1] + s * points[i, 0] + c * points[i, 1]
        r, q = math.floor(y / cell_m) - row0, math.floor(x / cell_m) - col0
        if r < 1 or q < 1 or r >= hits.shape[0] - 1 or q >= hits.shape[1] - 1:
            continue
        k = nearest[r, q]
        if k >= 0 and math.hypot(x - means[k, 0], y - means[k, 1]) < CLEARANCE_M:
            # A dynamic object may have been inserted before it was detected. It is not a
            # surface if beams have passed through it since.
            kr, kq = math.floor(means[k, 1] / cell_m) - row0, math.floor(means[k, 0] / cell_m) - col0
            known = 0 <= kr < hits.shape[0] and 0 <= kq < hits.shape[1]
            if known and MAX_MISSES_PER_HIT * int(hits[kr, kq]) >= int(misses[kr, kq]):
                continue
        free = True
        for rr in range(r - 1, r + 2):
            for qq in range(q - 1, q + 2):
                if misses[rr, qq] < MIN_FREE_SCANS or 8 * int(hits[rr, qq]) > int(misses[rr, qq]):
                    free = False
        out[i] = free


@kernel
def grow_along_beams(
    dynamic: np.ndarray,  # bool [M]
    points: np.ndarray,  # float64 [M, 2] in beam order
    beams: np.ndarray,  # int32 [M]
    gap_m: float,
    out: np.ndarray,  # out bool [M]
) -> None:
    """Extend the dynamic-beam mask along the beams to the edges of objects.

    Returns at an object's edge are in cells that are not certainly free. A neighbouring return (next beam,
    closer than `gap_m`) is marked too if it follows at least two marked returns; at most three returns are
    added per side.
    """
    m = dynamic.shape[0]
    for i in range(m):
        out[i] = dynamic[i]
    for direction in (1, -1):
        run = 0
        grown = 0
        for step in range(m):
            i = step if direction == 1 else m - 1 - step
            j = i - direction
            joined = (
                0 <= j < m
                and abs(beams[i] - beams[j]) <= 2
                and (math.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]) < gap_m)
            )
            if not joined:
                run, grown = 0, 0
            if dynamic[i]:
                run, grown = run + 1, 0
            elif joined and run >= 2 and grown < 3:
                out[i] = True
                grown += 1
            else:
                run = 0
    _mark_whole_objects(points, beams, gap_m, out)


@kernel
def _mark_whole_objects(points: np.ndarray, beams: np.ndarray, gap_m: float, out: np.ndarray) -> None:
    """Mark all returns of a connected object up to MAX_OBJECT_WIDTH_M if enough of them are marked."""
    m = out.shape[0]
    first = 0
    for i in range(1, m + 1):
        if i < m and (
            abs(beams[i] - beams[i - 1]) <= 2
            and math.hypot(points[i, 0] - points[i - 1, 0], points[i, 1] - points[i - 1, 1]) < gap_m
        ):
            continue
        width = math.hypot(points[i - 1, 0] - points[first, 0], points[i - 1, 1] - points[first, 1])
        dynamic = 0
        for k in range(first, i):
            dynamic += out[k]
        if width < MAX_OBJECT_WIDTH_M and dynamic >= max(2.0, MIN_DYNAMIC_RATIO * (i - first)):
            out[first:i] = True
        first = i
