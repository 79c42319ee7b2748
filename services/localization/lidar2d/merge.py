"""Merging of two lidar maps: relative pose of the maps, then loop closures between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint, Submap
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.services.localization.lidar2d.trajectory_record import TrajectoryRecord

QUERY_SCANS = 24  # number of scans of map b that are relocalized in map a
MIN_AGREEING_SCANS = 3
ALIGNED_SIGMA_M, ALIGNED_SIGMA_RAD = 0.15, math.radians(1.5)  # of the alignment, before loop closure
SAME_POSE_M, SAME_POSE_RAD = 0.4, math.radians(4.0)  # tolerance for equal poses


@dataclass(frozen=True)
class MapAlignment:
    """Pose of map b in map a, with the number of scans of map b whose relocalization agrees with it."""

    pose_a_b: np.ndarray  # float64 [3]
    agreeing: int  # number of scans that support this pose
    queried: int  # number of scans that were relocalized


def find_alignment(a: LidarSlam, b: LidarSlam) -> MapAlignment | None:
    """Find the pose of map b in map a by relocalization of scans; None if ambiguous or not confirmed."""
    nodes = list(b.pose_graph.nodes.values())
    chosen = [nodes[i] for i in np.unique(np.linspace(0, len(nodes) - 1, QUERY_SCANS).round().astype(int))]
    poses_a_b = []
    for node in chosen:
        found = a.relocalize_features(node.scan.features.astype(np.float64), node.scan.origin)
        if found.confidence >= 0.5:
            poses_a_b.append(
                se2.compose(found.pose_map_body, se2.inverse(b.pose_graph.pose_map_node[node.id]))
            )
    if not poses_a_b:
        return None
    same = np.array([[_same(p, q) for q in poses_a_b] for p in poses_a_b])
    votes = same.sum(axis=1)
    best = int(np.argmax(votes))
    rival = int(votes[~same[best]].max(initial=0))
    if votes[best] < MIN_AGREEING_SCANS or rival * 2 > votes[best]:
        return None
    return MapAlignment(poses_a_b[best], int(votes[best]), len(chosen))


def _same(p: np.ndarray, q: np.ndarray) -> bool:
    """Return whether two poses [3] are equal within SAME_POSE_M and SAME_POSE_RAD."""
    turned = abs(math.remainder(p[2] - q[2], 2.0 * math.pi))
    return bool(np.hypot(*(p[:2] - q[:2])) < SAME_POSE_M and turned < SAME_POSE_RAD)


def merge_into(a: LidarSlam, b: LidarSlam, pose_a_b: np.ndarray, offset: int) -> int:
    """Insert map b into map a at `pose_a_b` [3], optimise; return the number of new loop closures.

    `offset` is added to the submap ids of b. Map b must not be used afterwards.
    """
    graph, other, first = a.pose_graph, b.pose_graph, a.pose_graph.next_node_id
    for id, node in other.nodes.items():
        graph.nodes[first + id] = replace(node, id=first + id)
        graph.pose_map_node[first + id] = se2.compose(pose_a_b, other.pose_map_node[id])
    for id, s in other.submaps.items():
        pose, members = se2.compose(pose_a_b, s.pose_map_submap), [first + m for m in s.members]
        graph.submaps[offset + id] = Submap(offset + id, s.pose_odom_submap, pose, members, s.frozen)
    graph.constraints += [
        replace(c, submap=offset + c.submap, node=first + c.node) for c in other.constraints
    ]
    graph.constraints.append(_link(graph, first + min(other.nodes), set(range(offset))))
    a.record = _merged_records(a.record, b.record, pose_a_b, first)
    graph.pending = [first + id for id in other.nodes]
    graph.unlinked_from = None  # both maps are one connected map now
    graph.resume_numbering()
    before = graph.loop_closures
    a.finish()
    return graph.loop_closures - before


def _link(graph: PoseGraph, node: int, submaps_a: set[int]) -> Constraint:
    """Return a loose constraint between a node of map b and the nearest submap of map a.

    It tells the loop closure search how well the alignment is known.
    """
    pose = graph.pose_map_node[node]
    near = min(
        (s for s in graph.submaps.values() if s.id in submaps_a),
        key=lambda s: float(np.hypot(*(s.pose_map_submap - pose)[:2])),
    )
    information = np.diag([ALIGNED_SIGMA_M**-2, ALIGNED_SIGMA_M**-2, ALIGNED_SIGMA_RAD**-2])
    return Constraint(near.id, node, se2.between(near.pose_map_submap, pose), information, True)


def _merged_records(
    a: TrajectoryRecord, b: TrajectoryRecord, pose_a_b: np.ndarray, first: int
) -> TrajectoryRecord:
    """Join the trajectory records of both maps, sorted by stamp; `first` is added to the node ids of b."""
    of_a, of_b = a.arrays(), b.arrays()
    poses = of_b["extra_poses"].copy()
    poses[:, 3:] = se2.compose_many(np.tile(pose_a_b, (len(poses), 1)), poses[:, 3:])
    of_b = of_b | {"extra_nodes": of_b["extra_nodes"] + first, "extra_poses": poses}
    joined = {key: np.concatenate([of_a[key], of_b[key]]) for key in of_a}
    order = np.argsort(joined["extra_stamps"], kind="stable")
    return TrajectoryRecord.of({key: array[order] for key, array in joined.items()})
