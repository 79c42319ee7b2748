"""What the back end remembers: keynodes with their scans, submaps, and the edges between them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.branch_bound import SearchPyramid, build_pyramid
from beamsplat.services.localization.lidar2d.graph_kernels import invert3
from beamsplat.services.localization.lidar2d.graph_optimisation import ConstraintArrays
from beamsplat.services.localization.lidar2d.scan import PreparedScan
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import FrozenMap, MatchTables


@dataclass(frozen=True)
class NodeScan:
    """The returns of one keynode, body frame, small types."""

    points: np.ndarray  # float32 [M, 2]
    tangents: np.ndarray  # float32 [M, 2]
    spacing_m: np.ndarray  # float32 [M]
    dynamic: np.ndarray  # bool [M]
    features: np.ndarray  # float32 [K, 5], see PreparedScan.features
    origin: np.ndarray  # float64 [2]

    @staticmethod
    def of(scan: PreparedScan, dynamic: np.ndarray) -> NodeScan:
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
    """A scan that entered the map."""

    id: int
    stamp_ns: int
    pose_odom_body: np.ndarray  # float64 [3]
    scan: NodeScan


@dataclass
class Submap:
    """A local map with a pose of its own; the anchor that everything built on it hangs on."""

    id: int
    pose_odom_submap: np.ndarray  # float64 [3], where it was started
    pose_map_submap: np.ndarray  # float64 [3], optimised
    members: list[int] = field(default_factory=list)  # keynode ids
    frozen: FrozenMap | None = None


@dataclass(frozen=True)
class Constraint:
    """A measured pose of a keynode in a submap."""

    submap: int  # submap id
    node: int  # keynode id
    pose_submap_node: np.ndarray  # float64 [3]
    information: np.ndarray  # float64 [3, 3]
    loop: bool


class TableCache:
    """Match tables and pyramids of finished submaps, the most recently used ones."""

    def __init__(self, reach_cells: int, capacity: int = 12) -> None:
        self._reach, self._capacity = reach_cells, capacity
        # Each entry keeps the map it was made from: a submap that was drawn anew has another one.
        self._tables: OrderedDict[int, tuple[FrozenMap, MatchTables]] = OrderedDict()
        self._pyramids: OrderedDict[int, tuple[FrozenMap, SearchPyramid]] = OrderedDict()
        self._global_map: tuple[object, object] | None = None
        self._lock = threading.Lock()

    def tables(self, submap: int, frozen: FrozenMap) -> MatchTables:
        """Tables of a submap's frozen map (recomputed if the map was replaced)."""
        return self._get(self._tables, submap, frozen, lambda: frozen.tables(self._reach))

    def pyramid(self, submap: int, frozen: FrozenMap) -> SearchPyramid:
        """Search pyramid of a submap's frozen map."""
        return self._get(self._pyramids, submap, frozen, lambda: _pyramid_of(self.tables(submap, frozen)))

    def global_map(self, key: object, make: Callable[[], object]) -> object:
        """The map of everything; only the latest is kept."""
        with self._lock:
            if self._global_map is not None and self._global_map[0] == key:
                return self._global_map[1]
        value = make()
        with self._lock:
            self._global_map = (key, value)
        return value

    def _get(self, store: OrderedDict, submap: int, frozen: FrozenMap, make: Callable[[], object]) -> object:
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
    """Edge arrays in the order the solver wants."""
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
    """Information of an edge: that of the match, limited by what a match cannot know about itself."""
    # (3 m)^-2 and (0.5 rad)^-2 keep the inverse finite where the scan says nothing.
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
    """Information of a keynode's edge into the younger submap, which it was not matched to.

    All those edges together tie two neighbouring submaps, by no more than the drift from one to the next; if
    they were as stiff as matches, a loop would have to bend steel and be taken for an outlier.
    """
    s = settings
    inner = np.linalg.inv(edge_information(match_information, s.edge_sigma_m, s.edge_sigma_rad))
    drift = s.submap_nodes * np.diag(
        [s.submap_drift_sigma_m**2, s.submap_drift_sigma_m**2, s.submap_drift_sigma_rad**2]
    )
    return np.linalg.inv(inner + drift)


def merged_features(nodes: list[TrajectoryNode], centre: TrajectoryNode, limit: int = 360) -> np.ndarray:
    """Features float64 [K, 5] of several keynodes in the body frame of one of them."""
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
    # One return per 10 cm cell: near walls would outvote far ones.
    cells = np.floor(merged[:, :2] / 0.1).astype(np.int64)
    _, index = np.unique(cells[:, 0] * 1_000_003 + cells[:, 1], return_index=True)
    merged = merged[np.sort(index)]
    return merged[:: max(1, -(-len(merged) // limit))]
