"""Uncertainty of relative poses in the pose graph, for search windows and consistency tests."""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d.graph_kernels import invert3
from beamsplat.services.localization.lidar2d.graph_optimisation import ConstraintArrays
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings

LEVER_M = 10.0  # weighs rotation against translation where a path is chosen
WINDOW_M, WINDOW_RAD = 0.15, math.radians(1.5)  # added to three sigma


@kernel
def _variances(information: np.ndarray, var_m: np.ndarray, var_rad: np.ndarray) -> None:
    """Write the variances (m^2, mean of x and y; rad^2) of constraints with information float64 [E, 3, 3]."""
    covariance = np.empty((3, 3))
    for i in range(information.shape[0]):
        invert3(information[i], covariance)
        var_m[i], var_rad[i] = 0.5 * (covariance[0, 0] + covariance[1, 1]), covariance[2, 2]


@kernel
def _submap_pairs(
    submap: np.ndarray,  # int32 [E]
    first: np.ndarray,  # int64 [N + 1], first constraint of each node
    var_m: np.ndarray,  # float64 [E]
    var_rad: np.ndarray,  # float64 [E]
    pairs: np.ndarray,  # out int64 [P, 2], row numbers of two submaps that share a node
    variances: np.ndarray,  # out float64 [P, 2], m^2 and rad^2
) -> int:
    """Write each two submaps that share a node with the variances of their relative pose; return how many."""
    count = 0
    for n in range(first.shape[0] - 1):
        for i in range(first[n], first[n + 1]):
            for j in range(first[n], i):
                pairs[count, 0], pairs[count, 1] = submap[i], submap[j]
                variances[count, 0], variances[count, 1] = var_m[i] + var_m[j], var_rad[i] + var_rad[j]
                count += 1
    return count


@kernel
def _propagate(
    order: np.ndarray,  # int64 [S], submaps by distance from the source
    parent: np.ndarray,  # int64 [S], -1 = none
    link: np.ndarray,  # int64 [S], link to the parent
    variances: np.ndarray,  # float64 [L, 2]
    positions_m: np.ndarray,  # float64 [S, 2]
    out: np.ndarray,  # out float64 [2, S], m^2 and rad^2; inf where not connected
) -> None:
    """Propagate the variances along a tree: a rotation at one link moves all that follow it by its lever."""
    n = positions_m.shape[0]
    var_m, var_rad = np.zeros(n), np.zeros(n)
    sum_x, sum_y, sum_square = np.zeros(n), np.zeros(n), np.zeros(n)
    for k in order:
        p = parent[k]
        if p < 0:
            continue
        x, y = 0.5 * (positions_m[k, 0] + positions_m[p, 0]), 0.5 * (positions_m[k, 1] + positions_m[p, 1])
        v = variances[link[k], 1]
        var_m[k], var_rad[k] = var_m[p] + variances[link[k], 0], var_rad[p] + v
        sum_x[k], sum_y[k] = sum_x[p] + v * x, sum_y[p] + v * y
        sum_square[k] = sum_square[p] + v * (x * x + y * y)
        px, py = positions_m[k, 0], positions_m[k, 1]
        lever = var_rad[k] * (px * px + py * py) - 2.0 * (sum_x[k] * px + sum_y[k] * py) + sum_square[k]
        out[0, k], out[1, k] = var_m[k] + max(lever, 0.0), var_rad[k]


class DriftScale:
    """Drift of this drive relative to the settings, learnt from the loops that it has closed.

    In a building of identical rooms only the drift tells them apart, and it differs by a factor of ten
    between lidars. The settings are for the worst; each job with loop closures is one measurement against
    them.
    """

    PRIOR_JOBS = 4.0  # the settings count as much as the loop closures of so many jobs
    LIMITS2 = (0.04, 1.0)
    MAX_SAMPLE = 4.0  # a wrong loop closure must not open the windows

    def __init__(self) -> None:
        self._sum, self._jobs = self.PRIOR_JOBS, self.PRIOR_JOBS

    @property
    def scale2(self) -> float:
        """Return the squared scale."""
        return min(max(self._sum / self._jobs, self.LIMITS2[0]), self.LIMITS2[1])

    def add(self, ratio2: float) -> None:
        """Add the mean squared error of a job's loop closures, relative to the variance by the settings."""
        self._sum += min(ratio2, self.MAX_SAMPLE)
        self._jobs += 1.0


class DriftModel:
    """Uncertainty of the relative pose of each two submaps, along the most certain path between them."""

    def __init__(
        self,
        edges: ConstraintArrays,
        pose_map_submap: np.ndarray,  # float64 [S, 3]
        n_nodes: int,
        settings: LidarSlamSettings,
        scale2: float = 1.0,  # measured drift between submaps relative to the settings, squared
    ) -> None:
        s, n = settings, len(pose_map_submap)
        var_m, var_rad = np.empty(len(edges.node)), np.empty(len(edges.node))
        # Constraints into the second submap include the drift between submaps, see
        # second_submap_information(): subtract it, then add it once.
        drift_m2, drift_rad2 = s.submap_drift_sigma_m**2, s.submap_drift_sigma_rad**2
        _variances(edges.information, var_m, var_rad)
        var_m = np.maximum(var_m - s.submap_nodes * drift_m2, 0.0) + scale2 * drift_m2
        var_rad = np.maximum(var_rad - s.submap_nodes * drift_rad2, 0.0) + scale2 * drift_rad2
        first = np.searchsorted(edges.node, np.arange(n_nodes + 1)).astype(np.int64)
        degree = np.diff(first)
        pairs = np.empty((int((degree * (degree - 1) // 2).sum()), 2), dtype=np.int64)
        variances = np.empty((len(pairs), 2))
        count = _submap_pairs(edges.submap, first, var_m, var_rad, pairs, variances)
        low, high = pairs[:count].min(axis=1), pairs[:count].max(axis=1)
        weight = variances[:count, 0] + LEVER_M**2 * variances[:count, 1]
        keep = np.flatnonzero(low != high)
        order = keep[np.lexsort((weight[keep], high[keep], low[keep]))]
        key = low[order] * n + high[order]
        best = order[np.r_[True, np.diff(key) > 0]] if len(order) else order
        self._key, self._variances = low[best] * n + high[best], variances[best]
        self._graph = coo_matrix((weight[best], (low[best], high[best])), shape=(n, n)).tocsr()
        self._positions_m = np.ascontiguousarray(pose_map_submap[:, :2])
        self._cache: dict[int, np.ndarray] = {}
        self.components = connected_components(self._graph, directed=False)[1]  # int32 [S]

    def variances(self, source: int) -> np.ndarray:
        """Return float64 [2, S]: variances (m^2, rad^2) of the pose of each submap relative to one submap.

        `source` is its row number. They are infinite for submaps that no constraint connects with it.
        """
        if source not in self._cache:
            # The stubs do not know one index with predecessors.
            distance, parent = dijkstra(  # type: ignore[call-overload]
                self._graph, directed=False, indices=source, return_predecessors=True
            )
            n = len(parent)
            child = np.arange(n)
            key = np.minimum(child, parent) * n + np.maximum(child, parent)
            link = np.minimum(np.searchsorted(self._key, key), max(len(self._key) - 1, 0))
            out = np.full((2, n), np.inf)
            out[:, source] = 0.0
            reached = np.isfinite(distance)
            order = np.argsort(distance, kind="stable")[: int(reached.sum())]
            if len(self._key):
                _propagate(
                    order, np.where(parent < 0, -1, parent).astype(np.int64), link.astype(np.int64),
                    self._variances, self._positions_m, out,
                )  # fmt: skip
            self._cache[source] = out
        return self._cache[source]

    def windows(self, source: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the search windows (m and rad, float64 [S] each) of all submaps, for a node of one submap.

        `source` is the row number of the submap of the node. A window is three sigma plus a constant.
        """
        var_m, var_rad = self.variances(source)
        return WINDOW_M + 3.0 * np.sqrt(var_m), WINDOW_RAD + 3.0 * np.sqrt(var_rad)
