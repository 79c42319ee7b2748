"""Beams that end where the map knows free space: people, carts, doors. They stay out of the map."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

FREE_SCANS = 5  # so many keynodes must have looked through a cell
CLEARANCE_M = 0.12  # a return this close to a known surface belongs to it


@njit(nogil=True, cache=True, error_model="numpy")
def contradicts_free_space(
    points: np.ndarray,  # float64 [M, 2] body frame
    T: np.ndarray,  # float64 [3] T_map_body
    nearest: np.ndarray,
    means: np.ndarray,
    hits: np.ndarray,
    misses: np.ndarray,  # uint8 [H, W]
    row0: int,
    col0: int,
    cell_m: float,
    out: np.ndarray,  # out bool [M]
) -> None:
    """A return is on something that was not there: its cell and all around it were seen free often, hit
    hardly ever, and no surface is near."""
    c, s = math.cos(T[2]), math.sin(T[2])
    for i in range(points.shape[0]):
        out[i] = False
        x, y = T[0] + c * points[i, 0] - s * points[i, 1], T[1] + s * points[i, 0] + c * points[i, 1]
        r, q = math.floor(y / cell_m) - row0, math.floor(x / cell_m) - col0
        if r < 1 or q < 1 or r >= hits.shape[0] - 1 or q >= hits.shape[1] - 1:
            continue
        k = nearest[r, q]
        if k >= 0 and math.hypot(x - means[k, 0], y - means[k, 1]) < CLEARANCE_M:
            continue
        free = True
        for rr in range(r - 1, r + 2):
            for qq in range(q - 1, q + 2):
                if misses[rr, qq] < FREE_SCANS or 8 * int(hits[rr, qq]) > int(misses[rr, qq]):
                    free = False
        out[i] = free


@njit(nogil=True, cache=True, error_model="numpy")
def grow_along_beams(
    moving: np.ndarray,  # bool [M]
    points: np.ndarray,  # float64 [M, 2] in beam order
    beams: np.ndarray,  # int32 [M]
    gap_m: float,
    out: np.ndarray,  # out bool [M]
) -> None:
    """The edge of a moving thing touches cells that are not surely free: neighbours of a moving return on the
    same object (next beam, close by) move with it if at least two returns on it were found to move."""
    m = moving.shape[0]
    for i in range(m):
        out[i] = moving[i]
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
            if moving[i]:
                run, grown = run + 1, 0
            elif joined and run >= 2 and grown < 3:
                out[i] = True
                grown += 1
            else:
                run = 0
