"""Elements of the pose graph: trajectory nodes with their scans, submaps, and their constraints."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.branch_bound import SearchPyramid, build_pyramid
from beamsplat.services.localization.lidar2d.graph_kernels import invert3
from beamsplat.services.localization.lidar2d.graph_optimisation import ConstraintArrays
from beamsplat.services.localization.lidar2d.scan import PreparedScan
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import FrozenMap, MatchTables

_T = TypeVar("_T")


@dataclass(frozen=True)
class NodeScan:
    """Range data of one node in the body frame, in compact types."""

    points: np.ndarray  # float32 [M, 2]
    tangents: np.ndarray  # float32 [M, 2]
    spacing_m: np.ndarray  # float32 [M]
    dynamic: np.ndarray  # bool [M], returns on dynamic objects
    features: np.ndarray  # float32 [K, 5] of static returns, see PreparedScan.features
    origin: np.ndarray  # float64 [2], the lidar in the body frame

    @staticmethod
    def of(scan: PreparedScan, dynamic: np.ndarray) -> NodeScan:
        """Create the scan of a node from a prepared scan and the mask bool [M] of dynamic returns."""
        static = ~dynamic[scan.match_index]
        return NodeScan(
            scan.points_body.astype(np.float32),
            scan.tangents.astype(np.float32),
            scan.spacing_m.astype(np.float32),
            dynamic,
            scan.features()[static].astype(np.float32),
            scan.origin_body,
        )


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class Constraint:
    """A measured pose of a node in a submap."""

    submap: int  # submap id
    node: int  # node id
    pose_submap_node: np.ndarray  # float64 [3]
    information: np.ndarray  # float64 [3, 3]
    loop: bool


class TableCache:
    """Cache of the match tables and search pyramids of the most recently used finished submaps."""

    def __init__(self, reach_cells: int, capacity: int = 12) -> None:
        self._reach, self._capacity = reach_cells, capacity
        # Each entry keeps the map that it was made from, to detect rebuilt submaps.
        self._tables: OrderedDict[int, tuple[FrozenMap, MatchTables]] = OrderedDict()
        self._pyramids: OrderedDict[int, tuple[FrozenMap, SearchPyramid]] = OrderedDict()
        self._global_map: tuple[object, Any] | None = None
        self._lock = threading.Lock()

    def tables(self, submap: int, frozen: FrozenMap) -> MatchTables:
        """Return the match tables of a submap, recomputed if `frozen` is another object than last time."""
        return self._get(self._tables, submap, frozen, lambda: frozen.tables(self._reach))

    def pyramid(self, submap: int, frozen: FrozenMap) -> SearchPyramid:
        """Return the search pyramid of a submap, recomputed if `frozen` is another object than last time."""
        return self._get(self._pyramids, submap, frozen, lambda: _pyramid_of(self.tables(submap, frozen)))

    def global_map(self, key: object, make: Callable[[], _T]) -> _T:
        """Return the global map with this key, made by `make()` if needed; only the latest map is cached."""
        with self._lock:
            if self._global_map is not None and self._global_map[0] == key:
                return cast(_T, self._global_map[1])
        value = make()
        with self._lock:
            self._global_map = (key, value)
        return value

    def _get(
        self,
        store: OrderedDict[int, tuple[FrozenMap, _T]],
        submap: int,
        frozen: FrozenMap,
        make: Callable[[], _T],
    ) -> _T:
        with self._lock:
            if submap in store and store[submap][0] is frozen:
                store.move_to_end(submap)
                return store[submap][1]
        value = make()
        with self._lock:
            store[submap] = (frozen, value)
            store.move_to_end(submap)
            while len(store) > self._capacity:
                store.popitem(last=False)
        return value


def _pyramid_of(tables: MatchTables) -> SearchPyramid:
    return build_pyramid(tables.field, tables.row0, tables.col0, tables.cell_m)


def constraint_arrays(
    constraints: list[Constraint], submap_row: dict[int, int], node_row: dict[int, int]
) -> ConstraintArrays:
    """Convert constraints to arrays, ordered by node; the dicts map submap and node ids to row numbers."""
    node = np.array([node_row[c.node] for c in constraints], dtype=np.int32)
    order = np.argsort(node, kind="stable")
    chosen = [constraints[i] for i in order]
    return ConstraintArrays(
        np.array([submap_row[c.submap] for c in chosen], dtype=np.int32),
        node[order],
        np.array([c.pose_submap_node for c in chosen]).reshape(-1, 3),
        np.array([c.information for c in chosen]).reshape(-1, 3, 3),
        np.array([c.loop for c in chosen], dtype=bool),
    )


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
