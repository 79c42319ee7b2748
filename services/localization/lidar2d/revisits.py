"""Revisits: places that were driven through before, found however far the pose has drifted since."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.drift_model import WINDOW_M, WINDOW_RAD, DriftModel
from beamsplat.services.localization.lidar2d.graph_optimisation import ConstraintArrays
from beamsplat.services.localization.lidar2d.look_alikes import is_ambiguous, look_alikes
from beamsplat.services.localization.lidar2d.loop_hypotheses import (
    MAX_HYPOTHESES,
    LoopHypothesis,
    select,
)
from beamsplat.services.localization.lidar2d.loops import verify_constraint
from beamsplat.services.localization.lidar2d.observability import reduce_unobservable
from beamsplat.services.localization.lidar2d.place_search import PlaceMatch, SearchTarget, search_places
from beamsplat.services.localization.lidar2d.pose_graph_data import (
    Constraint,
    edge_information,
    merged_features,
)
from beamsplat.services.localization.lidar2d.snapshot import Snapshot

MIN_CHUNK_OVERLAP = 0.5
MIN_TRUST = 0.3  # observability of a match along its weak direction
PER_CHUNK = 3  # hypotheses that are kept of one chunk
CHUNK_SIGMA_M, CHUNK_SIGMA_RAD = 0.05, math.radians(0.7)  # drift within a chunk
NEAR_WINDOW_M, NEAR_WINDOW_RAD = 2.0, math.radians(15.0)  # a prediction that is itself evidence
FAR_WINDOW_M = 12.0
# Evidence that accepts a set of hypotheses, by the window in which they were found.
# In buildings of identical rooms a chunk may fit at a wrong place over 30 m.
NEAR_EVIDENCE, FAR_EVIDENCE, WIDE_EVIDENCE = 2, 4, 12
RESTART_EVIDENCE, LOST_EVIDENCE = 4, 6  # where nothing is known of the place
SURE_EVIDENCE = 4  # after a restart, of a match that has no rival in the whole map
SURE_INLIER_RATIO, SURE_OVERLAP = 0.85, 0.7
DISTINCT_RATIO = 0.85  # a match with a lower score than this ratio of the best one is no rival
MAP_MARGIN_M = 5.0  # of the map around the driven path
SAME_PLACE_M, SAME_PLACE_RAD = 0.5, math.radians(10.0)


def find_revisits(
    snapshot: Snapshot,
    edges: ConstraintArrays,
    drift: DriftModel,
    submap_row: dict[int, int],
    node_row: dict[int, int],
) -> tuple[list[Constraint], list[LoopHypothesis]]:
    """Search the newest chunk of scans in all submaps where it may be.

    Returns the loop closures that are accepted now, and the hypotheses that wait for confirmation.
    """
    pool = [
        h for h in snapshot.hypotheses
        if h.constraint.submap in submap_row and h.constraint.node in node_row and h.own_submap in submap_row
    ]  # fmt: skip
    added = _hypotheses_of_newest(snapshot, edges, drift, submap_row, node_row)
    if not added:
        return [], pool
    pool = (pool + added)[-MAX_HYPOTHESES:]

    def variances(a: int, b: int) -> tuple[float, float]:
        m2, rad2 = drift.variances(submap_row[a])[:, submap_row[b]]
        return float(m2), float(rad2)

    accepted = select(
        pool,
        dict(zip(snapshot.submap_ids, snapshot.pose_map_submap)),
        dict(zip(snapshot.node_ids, snapshot.pose_map_node)),
        variances,
    )
    if not accepted:
        return [], pool
    nodes = {h.constraint.node for h in accepted}
    return [h.constraint for h in accepted], [h for h in pool if h.constraint.node not in nodes]


def _hypotheses_of_newest(
    snapshot: Snapshot,
    edges: ConstraintArrays,
    drift: DriftModel,
    submap_row: dict[int, int],
    node_row: dict[int, int],
) -> list[LoopHypothesis]:
    s = snapshot.settings
    members = snapshot.node_ids[-s.place_nodes :]
    if snapshot.unlinked_from is not None:
        members = [n for n in members if n >= snapshot.unlinked_from]
    if not members or not snapshot.frozen:
        return []
    centre = snapshot.nodes[members[len(members) // 2]]
    if any(h.constraint.node == centre.id for h in snapshot.hypotheses):
        return []  # the robot has hardly moved since the last search
    own = sorted(set(submaps_of(edges, node_row[centre.id]).tolist()))
    targets = _targets(snapshot, edges, drift, node_row, node_row[centre.id], own)
    if not targets:
        return []
    features = merged_features([snapshot.nodes[n] for n in members[::2]], centre, s.place_points)
    matches = search_places(
        features, centre.scan.origin, targets, snapshot.cache, s, MIN_CHUNK_OVERLAP, s.min_place_score,
        s.place_min_inlier_ratio,
    )  # fmt: skip
    windows = {t.submap: (t.window_m, t.window_rad) for t in targets}
    first_wide = next((m for m in matches[:PER_CHUNK] if windows[m.submap][0] > NEAR_WINDOW_M), None)
    likenesses = (
        look_alikes(
            first_wide.score, features, centre.scan.origin, snapshot, {snapshot.submap_ids[o] for o in own}
        )
        if first_wide is not None
        else []
    )
    predicted = {t.submap: t.pose_submap_chunk for t in targets}
    extent_m = np.ptp(snapshot.pose_map_node[:, :2], axis=0) + 2.0 * MAP_MARGIN_M
    area_m2 = float(extent_m[0] * extent_m[1])
    hypotheses = []
    for m in matches[:PER_CHUNK]:
        tables = snapshot.cache.tables(m.submap, snapshot.frozen[m.submap], for_search=False)
        seen = reduce_unobservable(features, centre.scan.origin, m.match, tables, s)
        if seen.trust < MIN_TRUST or m.score < DISTINCT_RATIO * matches[0].score:
            continue  # it could be anywhere along a corridor, or the chunk fits clearly better elsewhere
        window_m, window_rad = windows[m.submap]
        if NEAR_WINDOW_M < window_m < math.inf and not snapshot.restarted:
            pose_map_submap = snapshot.pose_map_submap[submap_row[m.submap]]
            others = [se2.between(pose_map_submap, pose) for pose in likenesses]
            sigmas = (window_m - WINDOW_M) / 3.0, (window_rad - WINDOW_RAD) / 3.0
            if is_ambiguous(m.match.pose_target_body, predicted[m.submap], *sigmas, others, area_m2):
                continue
        information = edge_information(seen.match.information, CHUNK_SIGMA_M, CHUNK_SIGMA_RAD)
        link = Constraint(m.submap, centre.id, m.match.pose_target_body, information, True)
        confirmed = verify_constraint(
            link,
            snapshot.node_ids,
            snapshot.nodes,
            snapshot.members,
            snapshot.frozen,
            dict(zip(snapshot.submap_ids, snapshot.pose_map_submap)),
            dict(zip(snapshot.node_ids, snapshot.pose_map_node)),
            snapshot.cache,
            s,
        )
        rival = _rival_ratio(matches, snapshot) if m is matches[0] else 1.0
        evidence = 2 if confirmed or rival < DISTINCT_RATIO else 1
        fits = m.match.inlier_ratio >= SURE_INLIER_RATIO and m.match.overlap >= SURE_OVERLAP
        if fits and rival < s.link_max_runner_up_ratio and snapshot.restarted:
            evidence = SURE_EVIDENCE
        measurements = m.match.overlap * len(features) / s.returns_per_measurement
        needed = _needed(window_m, window_rad, snapshot.restarted)
        hypotheses.append(
            LoopHypothesis(
                link, snapshot.submap_ids[own[0]], evidence, needed, m.match.inlier_ratio, measurements
            )
        )
    return hypotheses


def _needed(window_m: float, window_rad: float, restarted: bool) -> int:
    """Return the evidence that is needed for a loop closure which was found in a window of this size."""
    if not math.isfinite(window_m):
        return RESTART_EVIDENCE if restarted else LOST_EVIDENCE
    if window_m <= NEAR_WINDOW_M and window_rad <= NEAR_WINDOW_RAD:
        return NEAR_EVIDENCE
    return FAR_EVIDENCE if window_m <= FAR_WINDOW_M else WIDE_EVIDENCE


def _rival_ratio(matches: list[PlaceMatch], snapshot: Snapshot) -> float:
    """Return the score of the best match at another place than the first one, relative to its score."""
    row = {s: i for i, s in enumerate(snapshot.submap_ids)}
    poses = [se2.compose(snapshot.pose_map_submap[row[m.submap]], m.match.pose_target_body) for m in matches]
    for m, pose in zip(matches[1:], poses[1:]):  # best first
        off = se2.between(poses[0], pose)
        if math.hypot(off[0], off[1]) > SAME_PLACE_M or abs(off[2]) > SAME_PLACE_RAD:
            return m.score / matches[0].score
    return 0.0


def _targets(
    snapshot: Snapshot,
    edges: ConstraintArrays,
    drift: DriftModel,
    node_row: dict[int, int],
    row: int,
    own: list[int],
) -> list[SearchTarget]:
    """Return the submaps in which the node in `row` may be, but too uncertainly for a local match."""
    s = snapshot.settings
    window_m, window_rad = drift.windows(own[0])
    distance = nearest_member(snapshot, edges, row)
    distance[own] = np.inf
    local = (window_m <= s.local_window_m) & (window_rad <= s.local_window_rad)
    free = ~np.isfinite(window_m)
    possible = ~local & np.isfinite(distance) & (free | (distance < s.loop_distance_m + window_m))
    ratio = np.where(free, 0.0, distance / window_m)
    targets: list[SearchTarget] = []
    chosen: set[int] = set()
    for k in np.flatnonzero(possible)[np.argsort(ratio[possible], kind="stable")].tolist():
        submap_id = snapshot.submap_ids[k]
        # Consecutive submaps share half of their scans.
        if submap_id not in snapshot.frozen or {submap_id - 1, submap_id + 1} & chosen:
            continue
        chosen.add(submap_id)
        path = [node_row[m] for m in snapshot.members[submap_id][::4] if m in node_row]
        poses = snapshot.pose_map_node[path]
        inverse = se2.inverse(snapshot.pose_map_submap[k])
        targets.append(
            SearchTarget(
                submap_id,
                snapshot.frozen[submap_id],
                se2.transform(inverse, poses[:, :2]),
                se2.between(snapshot.pose_map_submap[k], snapshot.pose_map_node[row]),
                float(window_m[k]),
                float(window_rad[k]),
            )
        )
        if len(targets) == s.max_place_targets:
            break
    return targets


def submaps_of(edges: ConstraintArrays, row: int) -> np.ndarray:
    """Return the row numbers of the submaps that contain the node with row number `row`."""
    lo, hi = np.searchsorted(edges.node, [row, row + 1])
    return edges.submap[lo:hi][~edges.robust[lo:hi]]


def nearest_member(snapshot: Snapshot, edges: ConstraintArrays, row: int) -> np.ndarray:
    """Return the distance (m) from the node in `row` to the nearest node of each submap, float64 [S]."""
    distance = np.full(len(snapshot.submap_ids), np.inf)
    _nearest_member(edges.submap, edges.node, edges.robust, snapshot.pose_map_node, row, distance)
    return distance


@kernel
def _nearest_member(
    submap: np.ndarray,
    node: np.ndarray,
    robust: np.ndarray,
    pose_map_node: np.ndarray,
    row: int,
    out: np.ndarray,
) -> None:
    x, y = pose_map_node[row, 0], pose_map_node[row, 1]
    for i in range(node.shape[0]):
        if not robust[i]:
            dx, dy = pose_map_node[node[i], 0] - x, pose_map_node[node[i], 1] - y
            out[submap[i]] = min(out[submap[i]], dx * dx + dy * dy)
    for k in range(out.shape[0]):
        out[k] = math.sqrt(out[k])
