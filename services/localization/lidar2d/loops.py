"""Loop closure: matching of a node near its predicted pose, and verification of loop closures."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.correlative import search
from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap
from beamsplat.services.localization.lidar2d.observability import (
    keep_guess_if_unobservable,
    reduce_unobservable,
)
from beamsplat.services.localization.lidar2d.pose_graph_data import (
    Constraint,
    TableCache,
    TrajectoryNode,
    edge_information,
)
from beamsplat.services.localization.lidar2d.scan_matching import Match, refine
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings

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
            cache.tables(submap, frozen[submap], for_search=False),
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
