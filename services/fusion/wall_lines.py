"""Line segments of straight walls in the lidar map, extrapolated behind furniture.

Cupboards, sofas and worktops hide the lower part of a wall from a lidar near the floor, while the upper part
is visible in the image. Walls are straight, so a line fitted to the measured part predicts the hidden part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.compiled import kernel

_ANGLES = 180  # of the Hough transform, over 180 degrees
_NEAR_M = 0.06  # distance of inliers from a line
_REACH_M = 5.0  # extrapolation beyond the outermost inliers
_PIECE_M, _GAP_M = 0.7, 0.15  # least length of a segment without gaps larger than `_GAP_M`
_GRAZING = 0.12  # sine of the least angle between ray and line


@dataclass(frozen=True)
class WallLine:
    """A line n . p = offset_m in the floor plane, measured from `low_m` to `high_m` along (-n_y, n_x)."""

    normal: np.ndarray  # float64 [2], unit
    offset_m: float
    low_m: float
    high_m: float


def find_lines(points_m: np.ndarray, cell_m: float, least_m: float = 1.2, most: int = 24) -> list[WallLine]:
    """Return lines through points float64 [N, 2], most inliers first (Hough transform, least squares).

    Args:
        points_m: one point per occupied cell, in the floor plane.
        cell_m: cell size, equal to the spacing of the points along a wall.
        least_m: smallest total length of the inliers of a line.
        most: largest number of lines.
    """
    left = points_m
    lines: list[WallLine] = []
    least = max(least_m / cell_m, 8.0)
    while len(lines) < most and len(left) >= least:
        reach_m = float(np.abs(left).sum(axis=1).max()) + 1.0
        votes = np.zeros((_ANGLES, int(2 * reach_m / cell_m) + 2), np.int32)
        hough_vote(left, cell_m, reach_m, votes)
        angle, row = np.unravel_index(int(np.argmax(votes)), votes.shape)
        theta = angle * np.pi / _ANGLES
        normal, offset = np.array([np.cos(theta), np.sin(theta)]), float((row + 0.5) * cell_m - reach_m)
        for _ in range(2):
            near = np.abs(left @ normal - offset) < _NEAR_M
            if np.count_nonzero(near) < least:
                break
            centre = left[near].mean(axis=0)
            normal = np.linalg.svd(left[near] - centre, full_matrices=False)[2][1]
            offset = float(normal @ centre)
        near = np.abs(left @ normal - offset) < _NEAR_M
        if np.count_nonzero(near) < least:
            break
        along = np.sort(left[near] @ np.array([-normal[1], normal[0]]))
        pieces = np.split(along, np.flatnonzero(np.diff(along) > _GAP_M) + 1)
        # Clutter may be collinear by chance, but then it has gaps.
        if max(piece[-1] - piece[0] for piece in pieces) >= _PIECE_M:
            lines.append(WallLine(normal, offset, float(along[0]), float(along[-1])))
        left = left[~near]
    return lines


@kernel
def hough_vote(points: np.ndarray, cell_m: float, reach_m: float, votes: np.ndarray) -> None:
    """Add 1 to votes[angle, distance] for every line through each point [N, 2]."""
    for a in range(votes.shape[0]):
        c, s = np.cos(a * np.pi / votes.shape[0]), np.sin(a * np.pi / votes.shape[0])
        for i in range(points.shape[0]):
            votes[a, int((points[i, 0] * c + points[i, 1] * s + reach_m) / cell_m)] += 1


def ranges_to_lines(
    lines: list[WallLine],
    start_m: np.ndarray,  # float64 [2]
    azimuth_rad: np.ndarray,  # float64 [M]
    beyond_m: np.ndarray,  # float64 [M]: least range
    count: int,
) -> np.ndarray:
    """Return ranges (m) of the extrapolated lines on each ray, float64 [count, M], nearest first, NaN = none.

    Only intersections beyond `beyond_m` are returned.
    """
    directions = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)])
    rows = [np.full((count, len(azimuth_rad)), np.nan)]
    for line in lines:
        towards = line.normal @ directions
        with np.errstate(divide="ignore", invalid="ignore"):
            r = (line.offset_m - line.normal @ start_m) / towards
            along = np.array([-line.normal[1], line.normal[0]]) @ (start_m[:, None] + r * directions)
            good = (np.abs(towards) > _GRAZING) & (r > beyond_m)
        good &= (along > line.low_m - _REACH_M) & (along < line.high_m + _REACH_M)
        rows.append(np.where(good, r, np.nan)[None])
    return np.sort(np.concatenate(rows), axis=0)[:count]  # NaN sorts last
