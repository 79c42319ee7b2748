"""Loop closure: search windows from the drift model, local and global matching, verification."""

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

# Higher than for a single scan, because merged scans must discriminate between places.
MERGED_MIN_INLIER_RATIO = 0.80
# A second pose whose inlier ratio is this close to the best makes the result ambiguous.
AMBIGUITY_MARGIN = 0.06
# Offsets in nodes along the trajectory at which a global loop closure is verified.
VERIFICATION_OFFSETS = (
    -60,
    -48,
    -36,
    -24,
    -12,
    12,
    24,
)
VERIFICATION_MIN_INLIER_RATIO = 0.75  # mean over the verified nodes


@dataclass(frozen=True)
class LoopCandidate:
    """A submap to which a node may be matched, with the predicted relative pose and the search window."""

    submap: int
    frozen: FrozenMap
    pose_submap_node: np.ndarray  # float64 [3], predicted
    window_m: float
    window_rad: float


@kernel
def _submap_pair_variances(
    submap: np.ndarray, first: np.ndarray, var_m: np.ndarray, var_rad: np.ndarray, links: np.ndarray
) -> None:
    """Write to `links` the smallest variance of the relative pose of each two submaps that share a node.

    `links` is float64 [3, S, S]: variance in m^2, variance in rad^2, and 1 where two submaps share a node.
    """
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
    """Uncertainty of the relative pose of two submaps: smallest sum of variances on a path between them."""

    def __init__(
        self, edges: ConstraintArrays, n_submaps: int, n_nodes: int, settings: LidarSlamSettings
    ) -> None:
        s = settings
        covariance = np.linalg.inv(edges.information)
        # Constraints into the second submap include the drift between submaps, see
        # second_submap_information(): subtract it, then add it once.
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
        """Return the search windows (m and rad, float64 [S] each) in all submaps, for a node of one submap.

        `source` is the row number of the submap of the node. A window is three sigma plus a constant.
        """
        var_m, var_rad, hops = (
            # The stubs do not know dense graphs.
            dijkstra(np.where(np.isfinite(links), links, 0.0), directed=False, indices=source)  # type: ignore[call-overload]
            for links in self._links
        )
        lever_m = np.minimum(hops * self._length_m / 3.0, 30.0)
        window_m = 0.15 + 3.0 * np.sqrt(var_m + var_rad * lever_m**2)
        return window_m, math.radians(1.5) + 3.0 * np.sqrt(var_rad)


def match_locally(
    node: TrajectoryNode, candidate: LoopCandidate, cache: TableCache, settings: LidarSlamSettings
) -> Constraint | None:
    """Match one scan to one submap near the predicted pose; return a constraint if it is accepted.

    The correlative search is used if the window is large or the first match is poor.
    """
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
    """Match merged scans to one submap by branch and bound; return a constraint if the pose is unambiguous.

    `neighbours` are nodes before and after `node`, whose scans are merged. The final match uses the scan of
    `node` alone.
    """
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
    # Compare inlier ratios only: a pose with a smaller overlap may be the right one. If the result is
    # ambiguous, as in corridors, there is no constraint.
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
    """Return whether nodes some metres before and after a global loop closure confirm it.

    The nodes around `link.node` are moved rigidly, so that the constraint `link` is fulfilled. The scan of
    each such node is then matched to the nearest submap of the other pass, at the moved pose.
    """
    shift = se2.compose(
        se2.compose(pose_map_submap[link.submap], link.pose_submap_node),
        se2.inverse(pose_map_node[link.node]),
    )
    position = {n: k for k, n in enumerate(node_ids)}
    near = [s for s in frozen if abs(s - link.submap) <= 6]
    node_positions = [(pose_map_node[m][:2], s) for s in near for m in members[s] if m in pose_map_node]
    where = np.array([p for p, _ in node_positions])
    ratios = []
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
            ratios.append(match.inlier_ratio)
    return len(ratios) >= 2 and float(np.mean(ratios)) >= VERIFICATION_MIN_INLIER_RATIO and min(ratios) >= 0.5


def match_score(match: Match) -> float:
    """Return overlap * (inlier_ratio - 0.5).

    Returns on surfaces increase the score, returns in free space decrease it, returns in unknown space do not
    change it.
    """
    return match.overlap * (match.inlier_ratio - 0.5)


def _constraint_if_accepted(
    node: TrajectoryNode, candidate: LoopCandidate, match: Match, settings: LidarSlamSettings
) -> Constraint | None:
    """Return a constraint if overlap and inlier ratio suffice and the pose is within the window."""
    if match.inlier_ratio < settings.loop_min_inlier_ratio or match.overlap < settings.loop_min_overlap:
        return None
    guess = candidate.pose_submap_node
    moved = np.hypot(*(match.pose_target_body[:2] - guess[:2]))
    turned = abs(math.remainder(match.pose_target_body[2] - guess[2], 2 * math.pi))
    if moved > 1.5 * candidate.window_m + 0.1 or turned > 1.5 * candidate.window_rad + 0.05:
        return None
    information = edge_information(match.information, settings.edge_sigma_m, settings.edge_sigma_rad)
    return Constraint(candidate.submap, node.id, match.pose_target_body, information, True)
