"""Global relocalization: one scan against all submaps of a map, without a prediction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.place_search import SearchTarget, search_places
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph

MIN_OVERLAP, MIN_SCORE, MIN_INLIER_RATIO = 0.3, 0.4, 0.5


@dataclass(frozen=True)
class Relocalization:
    """The best pose of a scan in a map; do not use a pose with a confidence below 0.5."""

    pose_map_body: np.ndarray  # float64 [3]
    confidence: float  # 0..1, from the fit of the scan and the lead over the best other pose
    covariance: np.ndarray  # float64 [3, 3]
    inlier_ratio: float  # returns on surfaces / returns in observed space
    overlap: float  # returns in observed space / all returns
    runner_up_ratio: float  # match_score of the best other pose / match_score of the best


def relocalize_in(
    graph: PoseGraph,
    features: np.ndarray,  # float64 [K, 5]
    origin: np.ndarray,  # float64 [2]
) -> Relocalization:
    """Find the best pose in the whole map for one scan, or for merged scans, without a prediction.

    Raises ValueError if the map is empty.
    """
    targets = _targets(graph)
    if not targets:
        raise ValueError("the map is empty: map an area first, or load a saved map")
    matches = search_places(
        features, origin, targets, graph.cache, graph.settings, MIN_OVERLAP, MIN_SCORE, MIN_INLIER_RATIO
    )
    poses = [se2.compose(graph.submaps[m.submap].pose_map_submap, m.match.pose_target_body) for m in matches]
    if not matches or matches[0].score <= 0.0:
        return Relocalization(np.zeros(3), 0.0, np.diag([1e4, 1e4, 10.0]), 0.0, 0.0, 1.0)
    best = matches[0].match
    others = [m.score for m, pose in zip(matches, poses) if _differ(pose, poses[0])]
    runner_up = max([*others, 0.0]) / matches[0].score
    fit = min(max((best.inlier_ratio - 0.6) / 0.25, 0.0), 1.0) * min(best.overlap / 0.7, 1.0)
    confidence = fit * min(max((1.0 - runner_up) / 0.1, 0.0), 1.0)
    turn = np.eye(3)
    c, s = np.cos(poses[0][2] - best.pose_target_body[2]), np.sin(poses[0][2] - best.pose_target_body[2])
    turn[:2, :2] = [[c, -s], [s, c]]
    covariance = turn @ np.linalg.inv(best.information + np.diag([0.1, 0.1, 4.0])) @ turn.T
    return Relocalization(poses[0], confidence, covariance, best.inlier_ratio, best.overlap, runner_up)


def _targets(graph: PoseGraph) -> list[SearchTarget]:
    """Return the finished submaps of the main part of the map, without those that overlap by half."""
    main = graph.main_submaps()
    targets: list[SearchTarget] = []
    for submap in graph.submaps.values():
        after = bool(targets) and targets[-1].submap == submap.id - 1
        if submap.frozen is None or submap.id not in main or after:
            continue
        path = np.array([graph.pose_map_node[m][:2] for m in submap.members[::4]])
        inverse = se2.inverse(submap.pose_map_submap)
        targets.append(
            SearchTarget(
                submap.id, submap.frozen, se2.transform(inverse, path), np.zeros(3), math.inf, math.inf
            )
        )
    return targets


def _differ(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two poses [3] are more than 0.3 m or 10 degrees apart."""
    off = se2.between(a, b)
    return bool(math.hypot(off[0], off[1]) > 0.3 or abs(off[2]) > math.radians(10.0))
