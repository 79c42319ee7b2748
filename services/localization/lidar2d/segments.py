"""Segments: after a restart, a kidnapping or a loss the new map hangs on nothing until its place is found."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.loops import LoopCandidate, match_locally
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint, merged_features
from beamsplat.services.localization.lidar2d.relocalization import GlobalMap, build_global_map, relocalize_in
from beamsplat.services.localization.lidar2d.snapshot import Snapshot

MAX_LINK_DISTANCE_M = 4.0  # the submap a new segment is tied to has a keynode within this distance


Candidate = tuple[int, np.ndarray]


def link_segment(
    snapshot: Snapshot,
) -> tuple[Constraint | None, np.ndarray, np.ndarray, Candidate | None]:
    """An edge from the newest keynode to the map and the poses with the segment moved there.

    Returns (None, poses as they were, the answer that waits for a second one) while the place is not certain.
    """
    submap_poses, node_poses = snapshot.pose_map_submap.copy(), snapshot.pose_map_node.copy()
    first = snapshot.unlinked_from
    row = {n: i for i, n in enumerate(snapshot.node_ids)}
    segment = [n for n in snapshot.node_ids if n >= first]
    known = [n for n in snapshot.node_ids if n < first]
    if not segment or not known:
        return None, submap_poses, node_poses, None
    newest = snapshot.nodes[segment[-1]]
    chunk = [snapshot.nodes[n] for n in segment[-snapshot.settings.merged_scans :]]
    global_map: GlobalMap = snapshot.cache.global_map(
        (snapshot.version, len(known)),
        lambda: build_global_map(
            snapshot.settings, [snapshot.nodes[n] for n in known], [node_poses[row[n]] for n in known]
        ),
    )
    answer = relocalize_in(global_map, merged_features(chunk, newest), newest.scan.origin, snapshot.settings)
    if answer.confidence < snapshot.settings.link_min_confidence:
        return None, submap_poses, node_poses, snapshot.candidate
    candidate = (newest.id, answer.pose_map_body)
    if answer.runner_up_ratio > snapshot.settings.link_max_runner_up_ratio and not _agrees(
        snapshot, candidate
    ):
        return None, submap_poses, node_poses, _next_candidate(snapshot, candidate)
    link = _link_to_submap(snapshot, newest.id, answer.pose_map_body, known, row, submap_poses, node_poses)
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


def _moved(snapshot: Snapshot, candidate: Candidate) -> np.ndarray:
    """Motion from the earlier answer's keynode to this one's, by the smooth poses."""
    earlier, _ = snapshot.candidate
    return se2.between(snapshot.nodes[earlier].pose_odom_body, snapshot.nodes[candidate[0]].pose_odom_body)


def _agrees(snapshot: Snapshot, candidate: Candidate) -> bool:
    """Whether an earlier answer, carried along, says the same from somewhere else."""
    if snapshot.candidate is None or snapshot.candidate[0] not in snapshot.nodes:
        return False
    moved = _moved(snapshot, candidate)
    off = se2.between(se2.compose(snapshot.candidate[1], moved), candidate[1])
    far = float(np.hypot(moved[0], moved[1])) >= snapshot.settings.link_min_distance_m
    return far and float(np.hypot(off[0], off[1])) < 0.3 and abs(float(off[2])) < math.radians(5.0)


def _next_candidate(snapshot: Snapshot, candidate: Candidate) -> Candidate:
    """Keep the earlier answer while the new one agrees but is too near to count; else start over."""
    if snapshot.candidate is None or snapshot.candidate[0] not in snapshot.nodes:
        return candidate
    off = se2.between(se2.compose(snapshot.candidate[1], _moved(snapshot, candidate)), candidate[1])
    same = float(np.hypot(off[0], off[1])) < 0.3 and abs(float(off[2])) < math.radians(5.0)
    return snapshot.candidate if same else candidate


def _link_to_submap(
    snapshot: Snapshot,
    node_id: int,
    pose_map_body: np.ndarray,
    known: list[int],
    row: dict[int, int],
    submap_poses: np.ndarray,
    node_poses: np.ndarray,
) -> Constraint | None:
    """The edge to the nearest finished submap that confirms the place."""
    positions = np.array([node_poses[row[n], :2] for n in known])
    away = dict(zip(known, np.hypot(*(positions - pose_map_body[:2]).T)))
    near = sorted(
        (min(away[m] for m in snapshot.members[s] if m in away), k, s)
        for k, s in enumerate(snapshot.submap_ids)
        if s in snapshot.frozen and any(m in away for m in snapshot.members[s])
    )
    for distance, k, s in near[:4]:
        if distance > MAX_LINK_DISTANCE_M:
            break
        place = LoopCandidate(
            s, snapshot.frozen[s], se2.between(submap_poses[k], pose_map_body), 0.3, math.radians(5.0)
        )
        link = match_locally(snapshot.nodes[node_id], place, snapshot.cache, snapshot.settings)
        if link is not None:
            return link
    return None
