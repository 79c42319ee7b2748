"""Selections of Gaussians for editing a map: by a polygon on the floor, by height, or because they float."""

from __future__ import annotations

import numpy as np

from beamsplat.common.raster.layout import MEAN, SCALE

FLOATER_GAP_M = 0.1  # the smallest gap between groups
_SPACINGS = 2.0  # and at least so many times the distance to the next Gaussian, which 90 % have


def in_polygon(points_xy: np.ndarray, corners_xy: np.ndarray) -> np.ndarray:
    """Return bool [N]: points [N, 2] inside a polygon with corners [K, 2], by the even-odd rule."""
    x, y = points_xy.T
    inside = np.zeros(len(points_xy), bool)
    for (ax, ay), (bx, by) in zip(corners_xy, np.roll(corners_xy, -1, axis=0)):
        crosses = (ay > y) != (by > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            inside ^= crosses & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return inside


def floaters(params: np.ndarray, smallest: int) -> np.ndarray:
    """Return bool [N]: Gaussians float32 [14, N] in groups of fewer than `smallest`.

    A group is what a gap separates from all others: 10 cm, or more in a map of few Gaussians. To within a
    factor of two: Gaussians in cells of this edge that touch each other, also at a corner, are of one group.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if params.shape[1] < 2:
        return np.full(params.shape[1], smallest > params.shape[1])
    means = params[MEAN:SCALE].T.astype(np.float64)
    some = means[:: -(-len(means) // 20_000)]
    to_next_m = np.asarray(cKDTree(means).query(some, 2)[0])[:, 1]
    gap_m = max(FLOATER_GAP_M, _SPACINGS * float(np.percentile(to_next_m, 90)))
    index = np.floor(means / gap_m).astype(np.int64)
    index -= index.min(axis=0) - 1
    spans = index.max(axis=0) + 2
    numbers = (index[:, 0] * spans[1] + index[:, 1]) * spans[2] + index[:, 2]
    cells, which, count = np.unique(numbers, return_inverse=True, return_counts=True)
    pairs = []
    for step in np.ndindex(3, 3, 3):
        offset = ((step[0] - 1) * spans[1] + step[1] - 1) * spans[2] + step[2] - 1
        if offset > 0:  # each pair once
            at = np.minimum(np.searchsorted(cells, cells + offset), len(cells) - 1)
            found = np.flatnonzero(cells[at] == cells + offset)
            pairs.append(np.stack([found, at[found]]))
    a, b = np.concatenate(pairs, axis=1)
    links = coo_array((np.ones(len(a), bool), (a, b)), (len(cells), len(cells)))
    _, group = connected_components(links, directed=False)
    size = np.bincount(group, weights=count)
    return size[group[which]] < smallest
