"""Refinement: rebuild the submaps from optimised poses and measure every constraint again."""

from __future__ import annotations

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap, freeze
from beamsplat.services.localization.lidar2d.observability import (
    keep_guess_if_unobservable,
    reduce_unobservable,
)
from beamsplat.services.localization.lidar2d.pose_graph_data import (
    Constraint,
    TrajectoryNode,
    edge_information,
)
from beamsplat.services.localization.lidar2d.scan_matching import refine
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import MatchTables, SurfelMap

UNMOVED_M, UNMOVED_RAD = 0.02, 0.005  # limits of _has_moved()


def rebuild_submap(
    settings: LidarSlamSettings,
    nodes: list[TrajectoryNode],
    pose_submap_node: list[np.ndarray],
    before: FrozenMap | None = None,
) -> FrozenMap:
    """Build a frozen map from the scans of nodes at the poses `pose_submap_node` (float64 [3] each).

    With `before`, the hit and miss counts are copied from this older map of the same nodes.
    """
    surfels = SurfelMap(settings)
    points = [
        se2.transform(pose, n.scan.points.astype(np.float64)) for n, pose in zip(nodes, pose_submap_node)
    ]
    surfels.cover(np.concatenate(points))
    for node, pose, points_submap in zip(nodes, pose_submap_node, points):
        scan = node.scan
        static = ~scan.dynamic
        surfels.insert(
            points_submap,
            se2.transform(np.array([0.0, 0.0, pose[2]]), scan.tangents.astype(np.float64)),
            scan.spacing_m.astype(np.float64),
            se2.transform(pose, scan.origin[None])[0],
            static,
            static if before is None else np.zeros_like(static),
            matchable=False,
        )
    return freeze(surfels, before)


def _has_moved(
    rebuilt: dict[int, np.ndarray], members: list[int], pose_submap_node: list[np.ndarray]
) -> bool:
    """Return whether any node has moved relative to the submap since it was inserted."""
    for node, pose in zip(members, pose_submap_node):
        if node not in rebuilt:
            return True
        moved = se2.between(rebuilt[node], pose)
        if abs(moved[0]) + abs(moved[1]) > UNMOVED_M or abs(moved[2]) > UNMOVED_RAD:
            return True
    return False


def refine_submaps(
    settings: LidarSlamSettings,
    nodes: dict[int, TrajectoryNode],
    members: dict[int, list[int]],
    frozen: dict[int, FrozenMap],
    constraints: list[Constraint],
    pose_map_submap: dict[int, np.ndarray],
    pose_map_node: dict[int, np.ndarray],
) -> list[Constraint]:
    """Rebuild the finished submaps from optimised poses; return the remeasured constraints.

    `frozen` is changed, so that not all submaps are in memory in both forms.
    """
    by_submap: dict[int, list[int]] = {}
    for k, c in enumerate(constraints):
        by_submap.setdefault(c.submap, []).append(k)
    remeasured = list(constraints)
    for submap in sorted(frozen):
        poses = [se2.between(pose_map_submap[submap], pose_map_node[n]) for n in members[submap]]
        own = [constraints[k] for k in by_submap.get(submap, []) if not constraints[k].loop]
        moved = _has_moved({c.node: c.pose_submap_node for c in own}, members[submap], poses)
        before = None if moved else frozen[submap]
        frozen[submap] = rebuild_submap(settings, [nodes[n] for n in members[submap]], poses, before)
        tables = frozen[submap].tables(settings.reach_cells, for_search=False)
        for k in by_submap.get(submap, []):
            remeasured[k] = _remeasure(
                settings,
                nodes[constraints[k].node],
                constraints[k],
                frozen[submap],
                tables,
                pose_map_submap[submap],
                pose_map_node[constraints[k].node],
            )
    return remeasured


def _remeasure(
    settings: LidarSlamSettings,
    node: TrajectoryNode,
    constraint: Constraint,
    frozen: FrozenMap,
    tables: MatchTables,
    pose_map_submap: np.ndarray,
    pose_map_node: np.ndarray,
) -> Constraint:
    """Match again from the optimised pose; return the new constraint, or the old one if the match fails."""
    features = node.scan.features.astype(np.float64)
    guess = se2.between(pose_map_submap, pose_map_node)
    match = refine(features, node.scan.origin, guess, tables, settings, anneal=(1.5,))
    moved = np.hypot(*(match.pose_target_body[:2] - guess[:2]))
    if (
        match.inlier_ratio < settings.loop_min_inlier_ratio
        or match.overlap < settings.loop_min_overlap
        or moved > 0.3
    ):
        return constraint
    match = keep_guess_if_unobservable(
        reduce_unobservable(features, node.scan.origin, match, tables, settings), guess
    )
    full = None if constraint.loop else match.full_information
    chosen = match.information if full is None else full
    information = edge_information(chosen, settings.edge_sigma_m, settings.edge_sigma_rad)
    if not constraint.loop:
        information /= settings.nodes_per_measurement
    return Constraint(
        constraint.submap, constraint.node, match.pose_target_body, information, constraint.loop
    )
