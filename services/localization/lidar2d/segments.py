"""Trajectory segments: after a restart or a loss of tracking, the new part of the map is disconnected.

A segment is connected as soon as relocalization finds its pose in the existing map.
"""

from __future__ import annotations

import math

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.loops import LoopCandidate, match_locally
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint, merged_features
from beamsplat.services.localization.lidar2d.relocalization import build_global_map, relocalize_in
from beamsplat.services.localization.lidar2d.snapshot import Snapshot

MAX_LINK_DISTANCE_M = 4.0  # a segment is linked to a submap that has a node within this distance


Candidate = tuple[int, np.ndarray]


def link_segment(
    snapshot: Snapshot,
) -> tuple[Constraint | None, np.ndarray, np.ndarray, Candidate | None]:
    """Relocalize the newest node of an unconnected segment in the map.

    Returns:
        1. The constraint between the newest node and a submap of the map; None while the pose is uncertain.
        2., 3. Submap and node poses in the map frame, float64 [S, 3] and [N, 3]. The segment is moved to its
        pose in the map; without a constraint, all poses are unchanged.
        4. A relocalization that must be confirmed by a later one (node id, pose_map_node), or None.
    """
    submap_poses, node_poses = snapshot.pose_map_submap.copy(), snapshot.pose_map_node.copy()
    first = snapshot.unlinked_from
    assert first is not None  # called for a segment that is not linked only
    row = {n: i for i, n in enumerate(snapshot.node_ids)}
    segment = [n for n in snapshot.node_ids if n >= first]
    map_nodes = [n for n in snapshot.node_ids if n < first]
    if not segment or not map_nodes:
        return None, submap_poses, node_poses, None
    newest = snapshot.nodes[segment[-1]]
    newest_nodes = [snapshot.nodes[n] for n in segment[-snapshot.settings.merged_scans :]]
    global_map = snapshot.cache.global_map(
        (snapshot.version, len(map_nodes)),
        lambda: build_global_map(
            snapshot.settings, [snapshot.nodes[n] for n in map_nodes], [node_poses[row[n]] for n in map_nodes]
        ),
    )
    found = relocalize_in(
        global_map, merged_features(newest_nodes, newest), newest.scan.origin, snapshot.settings
    )
    if found.confidence < snapshot.settings.link_min_confidence:
        return None, submap_poses, node_poses, snapshot.candidate
    candidate = (newest.id, found.pose_map_body)
    if found.runner_up_ratio > snapshot.settings.link_max_runner_up_ratio and not _agrees(
        snapshot, candidate
    ):
        return None, submap_poses, node_poses, _next_candidate(snapshot, candidate)
    link = _link_to_submap(snapshot, newest.id, found.pose_map_body, map_nodes, row, submap_poses, node_poses)
    if link is None:
        return None, submap_poses, node_poses, candidate
    submap_row = {s: i for i, s in enumerate(snapshot.submap_ids)}
    pose_map_newest = se2.compose(submap_poses[submap_row[link.submap]], link.pose_submap_node)
    shift = se2.compose(pose_map_newest, se2.inverse(node_poses[row[newest.id]]))
    for n in segment:
        node_poses[row[n]] = se2.compose(shift, node_poses[row[n]])
    for s, members in snapshot.members.items():
        if members and members[0] >= first:
            submap_poses[submap_row[s]] = se2.compose(shift, submap_poses[submap_row[s]])
    return link, submap_poses, node_poses, None


def _moved(snapshot: Snapshot, earlier: int, candidate: Candidate) -> np.ndarray:
    """Return the motion [3] from the node `earlier` to the node of the candidate, from their odom poses."""
    return se2.between(snapshot.nodes[earlier].pose_odom_body, snapshot.nodes[candidate[0]].pose_odom_body)


def _agrees(snapshot: Snapshot, candidate: Candidate) -> bool:
    """Return whether the earlier candidate, moved along the trajectory, is far enough away and agrees."""
    if snapshot.candidate is None or snapshot.candidate[0] not in snapshot.nodes:
        return False
    moved = _moved(snapshot, snapshot.candidate[0], candidate)
    off = se2.between(se2.compose(snapshot.candidate[1], moved), candidate[1])
    far = float(np.hypot(moved[0], moved[1])) >= snapshot.settings.link_min_distance_m
    return far and float(np.hypot(off[0], off[1])) < 0.3 and abs(float(off[2])) < math.radians(5.0)


def _next_candidate(snapshot: Snapshot, candidate: Candidate) -> Candidate:
    """Return the earlier candidate if the new one agrees but is too near to confirm it; else the new one."""
    if snapshot.candidate is None or snapshot.candidate[0] not in snapshot.nodes:
        return candidate
    moved = _moved(snapshot, snapshot.candidate[0], candidate)
    off = se2.between(se2.compose(snapshot.candidate[1], moved), candidate[1])
    same = float(np.hypot(off[0], off[1])) < 0.3 and abs(float(off[2])) < math.radians(5.0)
    return snapshot.candidate if same else candidate


def _link_to_submap(
    snapshot: Snapshot,
    node_id: int,
    pose_map_body: np.ndarray,
    map_nodes: list[int],
    row: dict[int, int],
    submap_poses: np.ndarray,
    node_poses: np.ndarray,
) -> Constraint | None:
    """Match the node to near finished submaps; return the first accepted constraint, None without any."""
    positions = np.array([node_poses[row[n], :2] for n in map_nodes])
    away = dict(zip(map_nodes, np.hypot(*(positions - pose_map_body[:2]).T)))
    near = sorted(
        (min(away[m] for m in snapshot.members[s] if m in away), k, s)
        for k, s in enumerate(snapshot.submap_ids)
        if s in snapshot.frozen and any(m in away for m in snapshot.members[s])
    )
    for distance, k, s in near[:4]:
        if distance > MAX_LINK_DISTANCE_M:
            break
        target = LoopCandidate(
            s, snapshot.frozen[s], se2.between(submap_poses[k], pose_map_body), 0.3, math.radians(5.0)
        )
        link = match_locally(snapshot.nodes[node_id], target, snapshot.cache, snapshot.settings)
        if link is not None:
            return link
    return None
