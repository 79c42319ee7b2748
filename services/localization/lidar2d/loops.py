"""Loop closure: which submaps a keynode may lie in, how uncertain that is, and where exactly it lies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import dijkstra

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.branch_bound import branch_and_bound
from beamsplat.services.localization.lidar2d.correlative import search
from beamsplat.services.localization.lidar2d.graph_optimisation import ConstraintArrays
from beamsplat.services.localization.lidar2d.observability import (
    keep_guess_if_unobservable,
    reduce_unobservable,
)
from beamsplat.services.localization.lidar2d.pose_graph_data import (
    Constraint,
    TableCache,
    TrajectoryNode,
    edge_information,
    merged_features,
)
from beamsplat.services.localization.lidar2d.scan_matching import Match, refine
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import FrozenMap

MERGED_MIN_INLIER_RATIO = (
    0.80  # a merged chunk must agree better than a single scan: it is what tells node_positions apart
)
AMBIGUITY_MARGIN = 0.06  # a second candidate whose share is this close to the best makes the answer worthless
VERIFICATION_OFFSETS = (
    -60,
    -48,
    -36,
    -24,
    -12,
    12,
    24,
)  # keynodes around a wide loop that must agree with it
VERIFICATION_MIN_INLIER_RATIO = 0.75


@dataclass(frozen=True)
class LoopCandidate:
    """A submap a keynode may lie in."""

    submap: int
    frozen: FrozenMap
    pose_submap_node: np.ndarray  # float64 [3] guess
    window_m: float
    window_rad: float


@kernel
def _submap_pair_variances(
    submap: np.ndarray, first: np.ndarray, var_m: np.ndarray, var_rad: np.ndarray, links: np.ndarray
) -> None:
    """Smallest variance from submap to submap over a shared node, float64 [3, S, S] (m2, rad2, hops)."""
    for n in range(first.shape[0] - 1):
        for i in range(first[n], first[n + 1]):
            for j in range(first[n], i):
                a, b = submap[i], submap[j]
                m, r = var_m[i] + var_m[j], var_rad[i] + var_rad[j]
                if m < links[0, a, b]:
                    links[0, a, b] = links[0, b, a] = m
                if r < links[1, a, b]:
                    links[1, a, b] = links[1, b, a] = r
                links[2, a, b] = links[2, b, a] = 1.0


class DriftModel:
    """How far two submaps may be off: the shortest path of uncertainties between them."""

    def __init__(
        self, edges: ConstraintArrays, n_submaps: int, n_nodes: int, settings: LidarSlamSettings
    ) -> None:
        s = settings
        covariance = np.linalg.inv(edges.information)
        # The edges into younger submaps carry the drift of a whole link each, see second_submap_information().
        per_edge = s.submap_nodes
        var_m = 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1]) - per_edge * s.submap_drift_sigma_m**2
        var_rad = covariance[:, 2, 2] - per_edge * s.submap_drift_sigma_rad**2
        var_m = np.maximum(var_m, 0.0) + s.submap_drift_sigma_m**2
        var_rad = np.maximum(var_rad, 0.0) + s.submap_drift_sigma_rad**2
        self._links = np.full((3, n_submaps, n_submaps), np.inf)
        first = np.searchsorted(edges.node, np.arange(n_nodes + 1)).astype(np.int64)
        _submap_pair_variances(edges.submap, first, var_m, var_rad, self._links)
        self._length_m = s.submap_nodes * s.motion_filter_distance_m

    def windows(self, source: int) -> tuple[np.ndarray, np.ndarray]:
        """Search windows (m, rad) of each submap, float64 [S] each, three sigma seen from one submap."""
        var_m, var_rad, hops = (
            dijkstra(np.where(np.isfinite(links), links, 0.0), directed=False, indices=source)
            for links in self._links
        )
        lever_m = np.minimum(hops * self._length_m / 3.0, 30.0)
        window_m = 0.15 + 3.0 * np.sqrt(var_m + var_rad * lever_m**2)
        return window_m, math.radians(1.5) + 3.0 * np.sqrt(var_rad)


def match_locally(
    node: TrajectoryNode, candidate: LoopCandidate, cache: TableCache, settings: LidarSlamSettings
) -> Constraint | None:
    """One scan against one submap, the guess is good to some decimetres."""
    tables = cache.tables(candidate.submap, candidate.frozen)
    features = node.scan.features.astype(np.float64)
    if len(features) < settings.min_points:
        return None
    best = refine(features, node.scan.origin, candidate.pose_submap_node, tables, settings)
    if candidate.window_m > 0.2 or candidate.window_rad > math.radians(4.0) or best.inlier_ratio < 0.8:
        for _, start_pose in search(
            features, candidate.pose_submap_node, tables, candidate.window_m, candidate.window_rad, 0.02
        ):
            other = refine(features, node.scan.origin, start_pose, tables, settings)
            if other.inlier_ratio * other.overlap > best.inlier_ratio * best.overlap + 0.02:
                best = other
    seen = reduce_unobservable(features, node.scan.origin, best, tables, settings)
    return _constraint_if_accepted(
        node, candidate, keep_guess_if_unobservable(seen, candidate.pose_submap_node), settings
    )


def match_globally(
    node: TrajectoryNode,
    neighbours: list[TrajectoryNode],
    candidate: LoopCandidate,
    cache: TableCache,
    settings: LidarSlamSettings,
) -> Constraint | None:
    """A chunk of scans against one submap by branch and bound, then the scan of its centre alone."""
    features = merged_features(neighbours, node)
    if len(features) < settings.min_points:
        return None
    window_m, window_rad = (
        min(candidate.window_m, settings.max_global_window_m),
        min(candidate.window_rad, math.pi),
    )
    found = branch_and_bound(
        features[:: max(1, len(features) // 150)],
        candidate.pose_submap_node,
        cache.pyramid(candidate.submap, candidate.frozen),
        window_m,
        window_rad,
        settings.min_global_score,
        keep=0.75,
    )
    if not found:
        return None
    tables = cache.tables(candidate.submap, candidate.frozen)
    matches = [refine(features, node.scan.origin, pose, tables, settings) for _, pose in found[:12]]
    matches = [m for m in matches if m.overlap >= settings.loop_min_overlap]
    matches.sort(key=lambda m: -m.inlier_ratio)
    if not matches or matches[0].inlier_ratio < MERGED_MIN_INLIER_RATIO:
        return None
    # A candidate only half known is as good an answer as one fully known: the share alone decides, and if it
    # cannot (corridors), there is no answer.
    best = matches[0]
    for other in matches[1:]:
        apart = np.hypot(*(other.pose_target_body[:2] - best.pose_target_body[:2])) > 0.3 or (
            abs(math.remainder(other.pose_target_body[2] - best.pose_target_body[2], 2 * math.pi)) > 0.1
        )
        if apart and other.inlier_ratio > best.inlier_ratio - AMBIGUITY_MARGIN:
            return None
    own = node.scan.features.astype(np.float64)
    single = refine(own, node.scan.origin, best.pose_target_body, tables, settings)
    return _constraint_if_accepted(
        node, candidate, reduce_unobservable(own, node.scan.origin, single, tables, settings).match, settings
    )


def verify_constraint(
    link: Constraint,
    node_ids: list[int],
    nodes: dict[int, TrajectoryNode],
    members: dict[int, list[int]],
    frozen: dict[int, FrozenMap],
    pose_map_submap: dict[int, np.ndarray],
    pose_map_node: dict[int, np.ndarray],
    cache: TableCache,
    settings: LidarSlamSettings,
) -> bool:
    """Whether keynodes metres before and after a wide loop see what its candidate says they should see.

    The neighbourhood of the node is laid rigidly over the neighbourhood of the submap; each check matches one
    scan against the submap of the other pass it then lies in.
    """
    shift = se2.compose(
        se2.compose(pose_map_submap[link.submap], link.pose_submap_node),
        se2.inverse(pose_map_node[link.node]),
    )
    position = {n: k for k, n in enumerate(node_ids)}
    near = [s for s in frozen if abs(s - link.submap) <= 6]
    node_positions = [(pose_map_node[m][:2], s) for s in near for m in members[s] if m in pose_map_node]
    where = np.array([p for p, _ in node_positions])
    shares = []
    for step in VERIFICATION_OFFSETS:
        k = position[link.node] + step
        if not 0 <= k < len(node_ids):
            continue
        node = nodes[node_ids[k]]
        pose_map_guess = se2.compose(shift, pose_map_node[node.id])
        away = np.hypot(*(where - pose_map_guess[:2]).T)
        if away.min() > settings.loop_distance_m:
            continue
        submap = node_positions[int(np.argmin(away))][1]
        if node.id in members[submap]:
            continue
        match = refine(
            node.scan.features.astype(np.float64),
            node.scan.origin,
            se2.between(pose_map_submap[submap], pose_map_guess),
            cache.tables(submap, frozen[submap]),
            settings,
        )
        if match.overlap >= settings.loop_min_overlap:
            shares.append(match.inlier_ratio)
    return len(shares) >= 2 and float(np.mean(shares)) >= VERIFICATION_MIN_INLIER_RATIO and min(shares) >= 0.5


def match_score(match: Match) -> float:
    """How much speaks for a match: returns on surfaces for it, returns in known free space against it,
    returns in unknown space neither."""
    return match.overlap * (match.inlier_ratio - 0.5)


def _constraint_if_accepted(
    node: TrajectoryNode, candidate: LoopCandidate, match: Match, settings: LidarSlamSettings
) -> Constraint | None:
    """A constraint if enough of what the scan sees is known there and agrees."""
    if match.inlier_ratio < settings.loop_min_inlier_ratio or match.overlap < settings.loop_min_overlap:
        return None
    guess = candidate.pose_submap_node
    moved = np.hypot(*(match.pose_target_body[:2] - guess[:2]))
    turned = abs(math.remainder(match.pose_target_body[2] - guess[2], 2 * math.pi))
    if moved > 1.5 * candidate.window_m + 0.1 or turned > 1.5 * candidate.window_rad + 0.05:
        return None
    information = edge_information(match.information, settings.edge_sigma_m, settings.edge_sigma_rad)
    return Constraint(candidate.submap, node.id, match.pose_target_body, information, True)
