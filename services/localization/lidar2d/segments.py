"""Segments: after a restart, a kidnapping or a loss the new map hangs on nothing until its place is found."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.loops import Place, close_narrow
from beamsplat.services.localization.lidar2d.nodes import Constraint, merged_features
from beamsplat.services.localization.lidar2d.relocalization import GlobalMap, build_global_map, relocalize_in
from beamsplat.services.localization.lidar2d.snapshot import Snapshot

REACH_M = 4.0  # the submap a new segment is tied to has a keynode within this distance


Candidate = tuple[int, np.ndarray]


def link_segment(
    snapshot: Snapshot,
) -> tuple[Constraint | None, np.ndarray, np.ndarray, Candidate | None]:
    """An edge from the newest keynode to the map and the poses with the segment moved there.

    Returns (None, poses as they were, the answer that waits for a second one) while the place is not certain.
    """
    T_s, T_n = snapshot.T_map_submap.copy(), snapshot.T_map_node.copy()
    first = snapshot.unlinked_from
    row = {n: i for i, n in enumerate(snapshot.node_ids)}
    segment = [n for n in snapshot.node_ids if n >= first]
    known = [n for n in snapshot.node_ids if n < first]
    if not segment or not known:
        return None, T_s, T_n, None
    newest = snapshot.nodes[segment[-1]]
    chunk = [snapshot.nodes[n] for n in segment[-snapshot.settings.chunk_keynodes :]]
    world: GlobalMap = snapshot.cache.world(
        (snapshot.version, len(known)),
        lambda: build_global_map(
            snapshot.settings, [snapshot.nodes[n] for n in known], [T_n[row[n]] for n in known]
        ),
    )
    answer = relocalize_in(world, merged_features(chunk, newest), newest.scan.origin, snapshot.settings)
    if answer.confidence < snapshot.settings.link_confidence:
        return None, T_s, T_n, snapshot.candidate
    candidate = (newest.id, answer.T_map_body)
    if answer.rival > snapshot.settings.link_alone_rival and not _agrees(snapshot, candidate):
        return None, T_s, T_n, _older(snapshot, candidate)
    link = _tie(snapshot, newest.id, answer.T_map_body, known, row, T_s, T_n)
    if link is None:
        return None, T_s, T_n, candidate
    submap_row = {s: i for i, s in enumerate(snapshot.submap_ids)}
    T_map_newest = se2.compose(T_s[submap_row[link.submap]], link.T_submap_node)
    T_shift = se2.compose(T_map_newest, se2.inverse(T_n[row[newest.id]]))
    for n in segment:
        T_n[row[n]] = se2.compose(T_shift, T_n[row[n]])
    for s, members in snapshot.members.items():
        if members and members[0] >= first:
            T_s[submap_row[s]] = se2.compose(T_shift, T_s[submap_row[s]])
    return link, T_s, T_n, None


def _moved(snapshot: Snapshot, candidate: Candidate) -> np.ndarray:
    """Motion from the earlier answer's keynode to this one's, by the smooth poses."""
    earlier, _ = snapshot.candidate
    return se2.between(snapshot.nodes[earlier].T_odom_body, snapshot.nodes[candidate[0]].T_odom_body)


def _agrees(snapshot: Snapshot, candidate: Candidate) -> bool:
    """Whether an earlier answer, carried along, says the same from somewhere else."""
    if snapshot.candidate is None or snapshot.candidate[0] not in snapshot.nodes:
        return False
    moved = _moved(snapshot, candidate)
    off = se2.between(se2.compose(snapshot.candidate[1], moved), candidate[1])
    far = float(np.hypot(moved[0], moved[1])) >= snapshot.settings.link_apart_m
    return far and float(np.hypot(off[0], off[1])) < 0.3 and abs(float(off[2])) < math.radians(5.0)


def _older(snapshot: Snapshot, candidate: Candidate) -> Candidate:
    """Keep the earlier answer while the new one agrees but is too near to count; else start over."""
    if snapshot.candidate is None or snapshot.candidate[0] not in snapshot.nodes:
        return candidate
    off = se2.between(se2.compose(snapshot.candidate[1], _moved(snapshot, candidate)), candidate[1])
    same = float(np.hypot(off[0], off[1])) < 0.3 and abs(float(off[2])) < math.radians(5.0)
    return snapshot.candidate if same else candidate


def _tie(
    snapshot: Snapshot,
    node_id: int,
    T_map_body: np.ndarray,
    known: list[int],
    row: dict[int, int],
    T_s: np.ndarray,
    T_n: np.ndarray,
) -> Constraint | None:
    """The edge to the nearest finished submap that confirms the place."""
    positions = np.array([T_n[row[n], :2] for n in known])
    away = dict(zip(known, np.hypot(*(positions - T_map_body[:2]).T)))
    near = sorted(
        (min(away[m] for m in snapshot.members[s] if m in away), k, s)
        for k, s in enumerate(snapshot.submap_ids)
        if s in snapshot.frozen and any(m in away for m in snapshot.members[s])
    )
    for distance, k, s in near[:4]:
        if distance > REACH_M:
            break
        place = Place(s, snapshot.frozen[s], se2.between(T_s[k], T_map_body), 0.3, math.radians(5.0))
        link = close_narrow(snapshot.nodes[node_id], place, snapshot.cache, snapshot.settings)
        if link is not None:
            return link
    return None
