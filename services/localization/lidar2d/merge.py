"""Two lidar maps made one: where one lies in the other, and the loops between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.pose_graph_data import Submap
from beamsplat.services.localization.lidar2d.relocalization import relocalize_in
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.services.localization.lidar2d.trajectory_record import TrajectoryRecord

QUERY_SCANS = 24  # scans of the second map that are looked for in the first
MIN_AGREEING_SCANS = 3
SAME_POSE_M, SAME_POSE_RAD = 0.4, math.radians(4.0)  # votes_cast that mean the same place


@dataclass(frozen=True)
class MapAlignment:
    """Where map b lies in map a, and how sure that is."""

    pose_a_b: np.ndarray  # float64 [3]
    agreeing: int  # scans that say so
    queried: int


def find_alignment(a: LidarSlam, b: LidarSlam) -> MapAlignment | None:
    """Looks for scans of b all over a. None where too few of the votes_cast agree, or others agree as much."""
    global_map, nodes = a.global_map(), list(b.pose_graph.nodes.values())
    chosen = [nodes[i] for i in np.unique(np.linspace(0, len(nodes) - 1, QUERY_SCANS).round().astype(int))]
    votes_cast = []
    for node in chosen:
        found = relocalize_in(global_map, node.scan.features.astype(np.float64), node.scan.origin, a.settings)
        if found.confidence >= 0.5:
            votes_cast.append(
                se2.compose(found.pose_map_body, se2.inverse(b.pose_graph.pose_map_node[node.id]))
            )
    if not votes_cast:
        return None
    same = np.array([[_same(p, q) for q in votes_cast] for p in votes_cast])
    votes = same.sum(axis=1)
    best = int(np.argmax(votes))
    rival = int(votes[~same[best]].max(initial=0))
    if votes[best] < MIN_AGREEING_SCANS or rival * 2 > votes[best]:
        return None
    return MapAlignment(votes_cast[best], int(votes[best]), len(chosen))


def _same(p: np.ndarray, q: np.ndarray) -> bool:
    turned = abs(math.remainder(p[2] - q[2], 2.0 * math.pi))
    return bool(np.hypot(*(p[:2] - q[:2])) < SAME_POSE_M and turned < SAME_POSE_RAD)


def merge_into(a: LidarSlam, b: LidarSlam, pose_a_b: np.ndarray, offset: int) -> int:
    """Puts map b into a at `pose_a_b` [3], finds the loops between them and optimises both as one.

    Submaps of b get `offset` added to their ids. Gives the number of loop closures found. b is used up.
    """
    graph, other, first = a.pose_graph, b.pose_graph, a.pose_graph.next_node_id
    for id, node in other.nodes.items():
        graph.nodes[first + id] = replace(node, id=first + id)
        graph.pose_map_node[first + id] = se2.compose(pose_a_b, other.pose_map_node[id])
    for id, s in other.submaps.items():
        place, members = se2.compose(pose_a_b, s.pose_map_submap), [first + m for m in s.members]
        graph.submaps[offset + id] = Submap(offset + id, s.pose_odom_submap, place, members, s.frozen)
    graph.constraints += [
        replace(c, submap=offset + c.submap, node=first + c.node) for c in other.constraints
    ]
    a.record = _merged_records(a.record, b.record, pose_a_b, first)
    graph.pending = [first + id for id in other.nodes]
    graph.unlinked_from = None  # the whole map hangs together from now on
    graph.resume_numbering()
    before = graph.loop_closures
    a.finish()
    return graph.loop_closures - before


def _merged_records(
    a: TrajectoryRecord, b: TrajectoryRecord, pose_a_b: np.ndarray, first: int
) -> TrajectoryRecord:
    """The scans of both, in order of time."""
    of_a, of_b = a.arrays(), b.arrays()
    poses = of_b["extra_poses"].copy()
    poses[:, 3:] = se2.compose_many(np.tile(pose_a_b, (len(poses), 1)), poses[:, 3:])
    of_b = of_b | {"extra_nodes": of_b["extra_nodes"] + first, "extra_poses": poses}
    joined = {key: np.concatenate([of_a[key], of_b[key]]) for key in of_a}
    order = np.argsort(joined["extra_stamps"], kind="stable")
    return TrajectoryRecord.of({key: array[order] for key, array in joined.items()})
