"""Records of the journal of a saved map, and the state that says which of them are part of the map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from beamsplat.common.files.journal import Record
from beamsplat.common.files.numbered_state import Arrays, packed_arrays
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap
from beamsplat.services.localization.lidar2d.node_scan import NodeScan
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint, Submap, TrajectoryNode
from beamsplat.services.localization.lidar2d.refinement import rebuild_submap
from beamsplat.services.localization.lidar2d.trajectory_record import TrajectoryRecord

NODES, SUBMAP, CONSTRAINTS, TRAJECTORY = 1, 2, 3, 4  # kinds of records
_BATCH_NODES, _BATCH_ROWS = 256, 4096  # in one record, so that it needs little memory
_M_PER_UNIT = 1e-4  # of the saved positions of nodes


@dataclass(frozen=True)
class SavedMap:
    """The parts of a map that are saved. It does not change, so that another thread can write it.

    It refers to the scans and submaps of the map; only lists are copied.
    """

    uuid: str
    nodes: list[TrajectoryNode]
    pose_map_node: list[np.ndarray]  # float64 [3], of the nodes
    submaps: list[Submap]  # copies
    constraints: list[Constraint]
    trimmed_nodes: dict[int, tuple[int, float, float, float]]
    record: TrajectoryRecord  # which only grows
    scans: int  # number of its rows at the time of the copy
    self_returns_m: np.ndarray | None  # float32 [self_returns.BINS]

    @staticmethod
    def of(graph: PoseGraph, record: TrajectoryRecord) -> SavedMap:
        """Return the parts of a map, without a copy of its scans and grids."""
        submaps = [
            Submap(s.id, s.pose_odom_submap, s.pose_map_submap, list(s.members), s.frozen)
            for s in graph.submaps.values()
        ]
        return SavedMap(
            graph.uuid, list(graph.nodes.values()), list(graph.pose_map_node.values()), submaps,
            list(graph.constraints), dict(graph.trimmed_nodes), record, record.count, graph.self_returns_m,
        )  # fmt: skip


# --- records --------------------------------------------------------------------------------------


def node_records(nodes: Sequence[TrajectoryNode]) -> Iterator[Record]:
    """Yield records of nodes with their scans."""
    for first in range(0, len(nodes), _BATCH_NODES):
        batch = nodes[first : first + _BATCH_NODES]
        arrays = {
            "id": np.array([n.id for n in batch], dtype=np.int64),
            "stamp_ns": np.array([n.stamp_ns for n in batch], dtype=np.int64),
            "pose_odom": np.array([n.pose_odom_body for n in batch]).reshape(-1, 3),
            "size": np.array([len(n.scan.data) for n in batch], dtype=np.int64),
            "data": np.frombuffer(b"".join(n.scan.data for n in batch), dtype=np.uint8),
        }
        yield NODES, packed_arrays(arrays)


def submap_record(submap: Submap) -> Record:
    """Return the record of a finished submap."""
    frozen = submap.frozen
    assert frozen is not None  # finished
    arrays = {
        "id": np.array(submap.id, dtype=np.int64),
        "pose_odom": submap.pose_odom_submap,
        "members": np.array(submap.members, dtype=np.int64),
        "grid": np.array([frozen.row0, frozen.col0, *frozen.shape], dtype=np.int64),
        "means": frozen.means, "omegas": frozen.omegas, "views": frozen.views,
        "packed": np.frombuffer(frozen.packed, dtype=np.uint8),
    }  # fmt: skip
    return SUBMAP, packed_arrays(arrays)


def constraint_records(constraints: Sequence[Constraint]) -> Iterator[Record]:
    """Yield records of constraints."""
    for first in range(0, len(constraints), _BATCH_ROWS):
        batch = constraints[first : first + _BATCH_ROWS]
        arrays = {
            "submap": np.array([c.submap for c in batch], dtype=np.int64),
            "node": np.array([c.node for c in batch], dtype=np.int64),
            "pose": np.array([c.pose_submap_node for c in batch]).reshape(-1, 3),
            "information": np.array([c.information for c in batch]).reshape(-1, 3, 3),
            "loop": np.array([c.loop for c in batch], dtype=bool),
        }
        yield CONSTRAINTS, packed_arrays(arrays)


def trajectory_records(record: TrajectoryRecord, first: int, end: int) -> Iterator[Record]:
    """Yield records of the scans in the rows `first` to before `end` of a trajectory record."""
    for row in range(first, end, _BATCH_ROWS):
        yield TRAJECTORY, packed_arrays(record.rows(row, min(row + _BATCH_ROWS, end)))


def state_arrays(
    saved: SavedMap, order: np.ndarray, nodes_in_use: np.ndarray, constraints_in_use: np.ndarray
) -> Arrays:
    """Return the small state: the poses, and what in the journal is part of the map.

    Args:
        order: int [len(saved.nodes)], sorts the nodes by their place in the journal.
        nodes_in_use: bool [N], by the order in the journal.
        constraints_in_use: bool [C], likewise.
    """
    poses = np.array(saved.pose_map_node).reshape(-1, 3)[order]
    limit = 2.0**31 - 1.0
    unfinished = [s for s in saved.submaps if s.frozen is None]
    trimmed = saved.trimmed_nodes
    own = {} if saved.self_returns_m is None else {"self_returns": saved.self_returns_m}
    return own | {
        "counts": np.array([len(nodes_in_use), len(constraints_in_use), saved.scans], dtype=np.int64),
        "node_in_use": np.packbits(nodes_in_use), "constraint_in_use": np.packbits(constraints_in_use),
        "node_xy": np.clip(np.rint(poses[:, :2] / _M_PER_UNIT), -limit, limit).astype(np.int32),
        "node_yaw": poses[:, 2].astype(np.float32),
        "submap_id": np.array([s.id for s in saved.submaps], dtype=np.int64),
        "submap_map": np.array([s.pose_map_submap for s in saved.submaps]).reshape(-1, 3),
        "unfinished_id": np.array([s.id for s in unfinished], dtype=np.int64),
        "unfinished_odom": np.array([s.pose_odom_submap for s in unfinished]).reshape(-1, 3),
        "unfinished_members": np.array([len(s.members) for s in unfinished], dtype=np.int64),
        "members": np.array([m for s in unfinished for m in s.members], dtype=np.int64),
        "trimmed": np.array([(id, t[0]) for id, t in trimmed.items()], dtype=np.int64).reshape(-1, 2),
        "trimmed_pose": np.array([t[1:] for t in trimmed.values()], dtype=np.float64).reshape(-1, 3),
    }  # fmt: skip


# --- restoring ------------------------------------------------------------------------------------


def restore(graph: PoseGraph, state: Arrays, parts: Iterable[tuple[int, Arrays]]) -> Arrays:
    """Add a saved map to an empty pose graph, from its state and the records of its journal.

    Submaps that were not finished are built again from their scans.

    Returns:
        The arrays of its trajectory record.

    Raises:
        KeyError, ValueError, IndexError, TypeError: state and records do not fit together.
    """
    graph.self_returns_m = state.get("self_returns")
    node_count, constraint_count, scans = state["counts"].tolist()
    node_used = np.unpackbits(state["node_in_use"], count=node_count).astype(bool)
    constraint_used = np.unpackbits(state["constraint_in_use"], count=constraint_count).astype(bool)
    ids = state["submap_id"].tolist()
    pose_map_submap = dict(zip(ids, state["submap_map"], strict=True))
    finished: dict[int, Submap] = {}
    constraints: list[Constraint] = []
    trajectory: list[Arrays] = []
    serial, first = 0, 0  # numbers of the next node and constraint in the journal
    for kind, a in parts:
        if kind == NODES:
            serial = _add_nodes(graph, a, node_used, serial)
        elif kind == SUBMAP and int(a["id"]) in pose_map_submap:
            submap = _submap(a, pose_map_submap[int(a["id"])], graph.settings.cell_m)
            finished[submap.id] = submap  # a later record replaces an earlier one
        elif kind == CONSTRAINTS:
            constraints += _constraints(a, constraint_used[first : first + len(a["submap"])])
            first += len(a["submap"])
        elif kind == TRAJECTORY:
            trajectory.append(a)
    if serial != len(node_used) or first != len(constraint_used):
        raise ValueError(f"{serial} nodes and {first} constraints in the journal")
    poses = np.column_stack([state["node_xy"] * _M_PER_UNIT, state["node_yaw"].astype(np.float64)])
    graph.pose_map_node = dict(zip(graph.nodes, poses, strict=True))
    unfinished = _unfinished(graph, state, pose_map_submap)
    for id in ids:
        if id in unfinished or id in finished:
            graph.submaps[id] = unfinished.get(id) or finished[id]
    graph.constraints = [c for c in constraints if c.submap in graph.submaps and c.node in graph.nodes]
    trimmed = zip(state["trimmed"].tolist(), state["trimmed_pose"].tolist(), strict=True)
    graph.trimmed_nodes = {id: (to, x, y, yaw) for (id, to), (x, y, yaw) in trimmed}
    rows = TrajectoryRecord.joined(trajectory)
    return {key: array[:scans] for key, array in rows.items()}


def _add_nodes(graph: PoseGraph, a: Arrays, used: np.ndarray, serial: int) -> int:
    """Add the nodes of a record that are in use; return the number of the next node in the journal."""
    data, ends = a["data"].tobytes(), np.cumsum(a["size"]).tolist()
    for k, id in enumerate(a["id"].tolist()):
        if used[serial + k]:
            scan = NodeScan(data[ends[k] - int(a["size"][k]) : ends[k]])
            scan.check()
            graph.nodes[id] = TrajectoryNode(id, int(a["stamp_ns"][k]), a["pose_odom"][k].copy(), scan)
    return serial + len(ends)


def _submap(a: Arrays, pose_map_submap: np.ndarray, cell_m: float) -> Submap:
    row0, col0, rows, cols = a["grid"].tolist()
    frozen = FrozenMap(
        a["means"], a["omegas"], a["views"], a["packed"].tobytes(), (rows, cols), row0, col0, cell_m
    )
    return Submap(int(a["id"]), a["pose_odom"], pose_map_submap, a["members"].tolist(), frozen)


def _constraints(a: Arrays, used: np.ndarray) -> list[Constraint]:
    return [
        Constraint(int(a["submap"][k]), int(a["node"][k]), pose, information, bool(a["loop"][k]))
        for k, (pose, information, use) in enumerate(zip(a["pose"], a["information"], used, strict=True))
        if use
    ]


def _unfinished(graph: PoseGraph, state: Arrays, pose_map_submap: dict[int, np.ndarray]) -> dict[int, Submap]:
    """Return the submaps that scans were being inserted into, built again from these scans."""
    ends, out = np.cumsum(state["unfinished_members"]).tolist(), {}
    for k, id in enumerate(state["unfinished_id"].tolist()):
        members = state["members"][ends[k] - int(state["unfinished_members"][k]) : ends[k]].tolist()
        if not members:
            continue
        nodes, pose = [graph.nodes[m] for m in members], state["unfinished_odom"][k]
        frozen = rebuild_submap(graph.settings, nodes, [se2.between(pose, n.pose_odom_body) for n in nodes])
        out[id] = Submap(id, pose, pose_map_submap[id], members, frozen)
    return out
