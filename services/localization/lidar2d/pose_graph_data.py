"""Elements of the pose graph: trajectory nodes with their scans, submaps, and their constraints."""

from __future__ import annotations

import operator
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap
from beamsplat.services.localization.lidar2d.graph_kernels import invert3
from beamsplat.services.localization.lidar2d.graph_optimisation import ConstraintArrays
from beamsplat.services.localization.lidar2d.node_scan import NodeScan
from beamsplat.services.localization.lidar2d.search_pyramid import SearchPyramid, search_pyramid
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import MatchTables

_K = TypeVar("_K")
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class TrajectoryNode:
    """A scan that was inserted into the submaps, with its pose in the odom frame."""

    id: int
    stamp_ns: int
    pose_odom_body: np.ndarray  # float64 [3]
    scan: NodeScan


@dataclass
class Submap:
    """A local map with its own pose; keyframes are anchored to submaps."""

    id: int
    pose_odom_submap: np.ndarray  # float64 [3], at its start
    pose_map_submap: np.ndarray  # float64 [3], optimised
    members: list[int] = field(default_factory=list)  # node ids
    frozen: FrozenMap | None = None


@dataclass(frozen=True, slots=True)
class Constraint:
    """A measured pose of a node in a submap."""

    submap: int  # submap id
    node: int  # node id
    pose_submap_node: np.ndarray  # float64 [3]
    information: np.ndarray  # float64 [3, 3]
    loop: bool


class TableCache:
    """Cache of the match tables and search pyramids of the most recently used finished submaps.

    Bounded by bytes, because a submap can cover a small room or a hall of 60 m x 60 m.
    """

    def __init__(self, reach_cells: int, limit_bytes: int = 64_000_000) -> None:
        self._reach, self._limit_bytes = reach_cells, limit_bytes
        # Each entry keeps the map that it was made from, to detect rebuilt submaps.
        self._tables: OrderedDict[tuple[int, bool], tuple[FrozenMap, MatchTables]] = OrderedDict()
        self._pyramids: OrderedDict[int, tuple[FrozenMap, SearchPyramid]] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        """Return the size of the cached tables and pyramids."""
        with self._lock:
            return _bytes_in(self._tables) + _bytes_in(self._pyramids)

    def tables(self, submap: int, frozen: FrozenMap, for_search: bool = True) -> MatchTables:
        """Return the match tables of a submap, recomputed if `frozen` is another object than last time.

        Without `for_search`, the likelihood field may be empty.
        """
        key = (submap, for_search)
        if not for_search and (submap, True) in self._tables:
            key = (submap, True)
        return self._get(self._tables, key, frozen, lambda: frozen.tables(self._reach, key[1]))

    def pyramid(self, submap: int, frozen: FrozenMap) -> SearchPyramid:
        """Return the search pyramid of a submap, recomputed if `frozen` is another object than last time."""
        return self._get(self._pyramids, submap, frozen, lambda: search_pyramid(frozen.means))

    def _get(
        self,
        store: OrderedDict[_K, tuple[FrozenMap, _T]],
        key: _K,
        frozen: FrozenMap,
        make: Callable[[], _T],
    ) -> _T:
        with self._lock:
            if key in store and store[key][0] is frozen:
                store.move_to_end(key)
                return store[key][1]
        value = make()
        with self._lock:
            store[key] = (frozen, value)
            store.move_to_end(key)
            while len(store) > 1 and _bytes_in(store) > self._limit_bytes // 2:
                store.popitem(last=False)
        return value


def _bytes_in(store: OrderedDict[Any, tuple[FrozenMap, Any]]) -> int:
    return sum(
        array.nbytes
        for _, value in store.values()
        for array in vars(value).values()
        if isinstance(array, np.ndarray)
    )


class ConstraintTable:
    """The columns of a list of constraints, kept from job to job: only what is new in the list is read.

    Not thread-safe; one background job at a time uses it.
    """

    def __init__(self) -> None:
        self._constraints: list[Constraint] = []
        self._ids = np.empty((1024, 2), dtype=np.int64)  # submap, node
        self._packed = np.empty((1024, 12))
        self._loop = np.empty(1024, dtype=bool)

    def arrays(
        self, constraints: list[Constraint], submap_row: dict[int, int], node_row: dict[int, int]
    ) -> ConstraintArrays:
        """Return the constraints as arrays, ordered by node; the dicts map submap and node ids to rows."""
        self._update(constraints)
        n = len(constraints)
        submap, node = _rows_of(self._ids[:n, 0], submap_row), _rows_of(self._ids[:n, 1], node_row)
        order = np.argsort(node, kind="stable")
        packed = self._packed[order]
        return ConstraintArrays(
            submap[order],
            node[order],
            np.ascontiguousarray(packed[:, :3]),
            np.ascontiguousarray(packed[:, 3:]).reshape(-1, 3, 3),
            self._loop[order],
        )

    def _update(self, constraints: list[Constraint]) -> None:
        known = len(self._constraints)
        if known > len(constraints) or not all(map(operator.is_, self._constraints, constraints)):
            known = 0
        while len(constraints) > len(self._ids):
            self._ids = np.concatenate([self._ids, np.empty_like(self._ids)])
            self._packed = np.concatenate([self._packed, np.empty_like(self._packed)])
            self._loop = np.concatenate([self._loop, np.empty_like(self._loop)])
        for row, c in enumerate(constraints[known:], known):
            self._ids[row] = c.submap, c.node
            self._packed[row, :3], self._packed[row, 3:] = c.pose_submap_node, c.information.ravel()
            self._loop[row] = c.loop
        self._constraints = list(constraints)


def _rows_of(ids: np.ndarray, row_of: dict[int, int]) -> np.ndarray:
    """Return the row int32 [N] of each id."""
    known = np.fromiter(row_of.keys(), dtype=np.int64, count=len(row_of))
    rows = np.fromiter(row_of.values(), dtype=np.int32, count=len(row_of))
    order = np.argsort(known)
    return rows[order][np.searchsorted(known, ids, sorter=order)]


@kernel
def edge_information(match_information: np.ndarray, sigma_m: float, sigma_rad: float) -> np.ndarray:
    """Return the information [3, 3] of a constraint: of the match, reduced by unmodelled errors.

    `sigma_m` and `sigma_rad` are the standard deviations of errors that the match cannot observe.
    """
    # (3 m)^-2 and (0.5 rad)^-2 keep the inverse finite in unobservable directions.
    regular, covariance, information = match_information.copy(), np.empty((3, 3)), np.empty((3, 3))
    regular[0, 0] += 0.1
    regular[1, 1] += 0.1
    regular[2, 2] += 4.0
    invert3(regular, covariance)
    covariance[0, 0] += sigma_m**2
    covariance[1, 1] += sigma_m**2
    covariance[2, 2] += sigma_rad**2
    invert3(covariance, information)
    return information


def second_submap_information(match_information: np.ndarray, settings: LidarSlamSettings) -> np.ndarray:
    """Return the information [3, 3] of the constraint between a node and the younger active submap.

    The scan was matched to the older submap only. All these constraints together connect two consecutive
    submaps, with the uncertainty of the drift between them. With the information of a match, true loop
    closures would be rejected as outliers.
    """
    s = settings
    inner = np.linalg.inv(edge_information(match_information, s.edge_sigma_m, s.edge_sigma_rad))
    drift = s.submap_nodes * np.diag(
        [s.submap_drift_sigma_m**2, s.submap_drift_sigma_m**2, s.submap_drift_sigma_rad**2]
    )
    return np.linalg.inv(inner + drift)


def merged_features(nodes: list[TrajectoryNode], centre: TrajectoryNode, limit: int = 360) -> np.ndarray:
    """Return the features float64 [K, 5] of several nodes in the body frame of the node `centre`."""
    parts = []
    for node in nodes:
        pose_centre_node = se2.between(centre.pose_odom_body, node.pose_odom_body)
        f = node.scan.features.astype(np.float64)
        turn = np.array([0.0, 0.0, pose_centre_node[2]])
        parts.append(
            np.column_stack(
                [se2.transform(pose_centre_node, f[:, :2]), se2.transform(turn, f[:, 2:4]), f[:, 4]]
            )
        )
    merged = np.concatenate(parts)
    # One return per 10 cm cell, because near walls have more returns than far ones.
    cells = np.floor(merged[:, :2] / 0.1).astype(np.int64)
    _, index = np.unique(cells[:, 0] * 1_000_003 + cells[:, 1], return_index=True)
    merged = merged[np.sort(index)]
    return merged[:: max(1, -(-len(merged) // limit))]
