"""Global relocalization in a map: branch and bound over the whole map, then scoring of the matches."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.branch_bound import (
    SearchPyramid,
    branch_and_bound,
    build_pyramid,
)
from beamsplat.services.localization.lidar2d.loops import match_score
from beamsplat.services.localization.lidar2d.pose_graph_data import TrajectoryNode
from beamsplat.services.localization.lidar2d.scan_matching import Match, refine
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import MatchTables, SurfelMap, freeze

SEARCH_RETURNS = 120  # returns used by branch and bound
CANDIDATES = 40  # poses that are refined
REFINE_FIRST = 6  # Gauss-Newton iterations for every candidate; only the best get all iterations


@dataclass(frozen=True)
class GlobalMap:
    """Match tables and search pyramid of a whole map, on one grid in the map frame."""

    tables: MatchTables
    pyramid: SearchPyramid
    centre_m: np.ndarray  # float64 [2]
    half_extent_m: float


@dataclass(frozen=True)
class Relocalization:
    """The best pose of a scan in a map; do not use a pose with a confidence below 0.5."""

    pose_map_body: np.ndarray  # float64 [3]
    confidence: float  # 0..1, from the fit of the scan and the lead over the best other pose
    covariance: np.ndarray  # float64 [3, 3]
    inlier_ratio: float  # returns on surfaces / returns in observed space
    overlap: float  # returns in observed space / all returns
    runner_up_ratio: float  # match_score of the best other pose / match_score of the best


def build_global_map(
    settings: LidarSlamSettings, nodes: list[TrajectoryNode], pose_map_node: list[np.ndarray]
) -> GlobalMap:
    """Build the map for relocalization from all nodes. Raises ValueError if there is no node."""
    if not nodes:
        raise ValueError("the map is empty: map an area first, or load a saved map")
    surfels = SurfelMap(settings)
    for node, pose in zip(nodes, pose_map_node):
        static = ~node.scan.dynamic
        surfels.insert(
            se2.transform(pose, node.scan.points.astype(np.float64)),
            se2.transform(np.array([0.0, 0.0, pose[2]]), node.scan.tangents.astype(np.float64)),
            node.scan.spacing_m.astype(np.float64),
            se2.transform(pose, node.scan.origin[None])[0],
            static,
            static,
            matchable=False,
        )
    tables = freeze(surfels).tables(settings.reach_cells)
    positions = np.array([pose[:2] for pose in pose_map_node])
    low, high = positions.min(axis=0), positions.max(axis=0)
    # The search is limited to 3 m around the driven trajectory.
    half = 0.5 * float((high - low).max()) + 3.0
    pyramid = build_pyramid(tables.field, tables.row0, tables.col0, tables.cell_m)
    return GlobalMap(tables, pyramid, 0.5 * (low + high), half)


def relocalize_in(
    global_map: GlobalMap,
    features: np.ndarray,  # float64 [K, 5]
    origin: np.ndarray,  # float64 [2]
    settings: LidarSlamSettings,
) -> Relocalization:
    """Find the best pose in the whole map for one scan, or for merged scans, without a prediction."""
    if len(features) < settings.min_points:
        return _no_match(global_map)
    centre = np.array([global_map.centre_m[0], global_map.centre_m[1], 0.0])
    subset = features[:: max(1, len(features) // SEARCH_RETURNS)]
    found = branch_and_bound(
        subset, centre, global_map.pyramid, global_map.half_extent_m, math.pi, 0.4, keep=0.85
    )
    rough = [
        refine(features, origin, pose, global_map.tables, settings, iterations=REFINE_FIRST)
        for _, pose in found[:CANDIDATES]
    ]
    rough.sort(key=lambda m: -match_score(m))
    matches = [
        refine(features, origin, m.pose_target_body, global_map.tables, settings, anneal=(1.5,))
        for m in rough[:6]
    ]
    matches.sort(key=lambda m: -match_score(m))
    if not matches or match_score(matches[0]) <= 0.0:
        return _no_match(global_map)
    best = matches[0]
    others = [match_score(m) for m in [*matches[1:], *rough] if _differ(m, best)]
    runner_up = max([*others, 0.0]) / match_score(best)
    fit = min(max((best.inlier_ratio - 0.6) / 0.25, 0.0), 1.0) * min(best.overlap / 0.7, 1.0)
    confidence = fit * min(max((1.0 - runner_up) / 0.1, 0.0), 1.0)
    covariance = np.linalg.inv(best.information + np.diag([0.1, 0.1, 4.0]))
    return Relocalization(
        best.pose_target_body, confidence, covariance, best.inlier_ratio, best.overlap, runner_up
    )


def _differ(a: Match, b: Match) -> bool:
    """Return whether two matches are more than 0.3 m or 10 degrees apart."""
    turned = abs(math.remainder(a.pose_target_body[2] - b.pose_target_body[2], 2.0 * math.pi))
    return bool(
        np.hypot(*(a.pose_target_body[:2] - b.pose_target_body[:2])) > 0.3 or turned > math.radians(10.0)
    )


def _no_match(global_map: GlobalMap) -> Relocalization:
    """Return a relocalization result with confidence 0, at the centre of the map."""
    pose = np.array([global_map.centre_m[0], global_map.centre_m[1], 0.0])
    return Relocalization(pose, 0.0, np.diag([1e4, 1e4, 10.0]), 0.0, 0.0, 1.0)
