"""Draw submaps anew from optimised poses and measure every edge again: what makes relations accurate."""

from __future__ import annotations

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.matching import refine
from beamsplat.services.localization.lidar2d.nodes import Constraint, Keynode, edge_information
from beamsplat.services.localization.lidar2d.observability import held_along, without_slip
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import FrozenMap, MatchTables, SurfelMap, freeze

STILL_M, STILL_RAD = 0.02, 0.005  # keynodes that moved less leave the free space of a submap as it was


def draw_submap(
    settings: LidarSlamSettings,
    nodes: list[Keynode],
    T_submap_node: list[np.ndarray],
    before: FrozenMap | None = None,
) -> FrozenMap:
    """A frozen map of keynodes at given poses; the free space is taken over where `before` is given."""
    surfels = SurfelMap(settings)
    points = [se2.transform(T, n.scan.points.astype(np.float64)) for n, T in zip(nodes, T_submap_node)]
    surfels.cover(np.concatenate(points))
    for node, T, there in zip(nodes, T_submap_node, points):
        scan = node.scan
        still = ~scan.moving
        surfels.insert(
            there,
            se2.transform(np.array([0.0, 0.0, T[2]]), scan.tangents.astype(np.float64)),
            scan.spacing_m.astype(np.float64),
            se2.transform(T, scan.origin[None])[0],
            still,
            still if before is None else np.zeros_like(still),
            matchable=False,
        )
    return freeze(surfels, before)


def _has_moved(drawn: dict[int, np.ndarray], members: list[int], T_submap_node: list[np.ndarray]) -> bool:
    """Whether any keynode left the place it was drawn at."""
    for node, T in zip(members, T_submap_node):
        if node not in drawn:
            return True
        moved = se2.between(drawn[node], T)
        if abs(moved[0]) + abs(moved[1]) > STILL_M or abs(moved[2]) > STILL_RAD:
            return True
    return False


def refine_submaps(
    settings: LidarSlamSettings,
    nodes: dict[int, Keynode],
    members: dict[int, list[int]],
    frozen: dict[int, FrozenMap],
    constraints: list[Constraint],
    T_map_submap: dict[int, np.ndarray],
    T_map_node: dict[int, np.ndarray],
) -> tuple[dict[int, FrozenMap], list[Constraint]]:
    """New maps of the finished submaps and all constraints measured in them."""
    drawn: dict[int, FrozenMap] = {}
    by_submap: dict[int, list[int]] = {}
    for k, c in enumerate(constraints):
        by_submap.setdefault(c.submap, []).append(k)
    measured = list(constraints)
    for submap in sorted(frozen):
        poses = [se2.between(T_map_submap[submap], T_map_node[n]) for n in members[submap]]
        own = [constraints[k] for k in by_submap.get(submap, []) if not constraints[k].loop]
        moved = _has_moved({c.node: c.T_submap_node for c in own}, members[submap], poses)
        before = None if moved else frozen[submap]
        drawn[submap] = draw_submap(settings, [nodes[n] for n in members[submap]], poses, before)
        tables = drawn[submap].tables(settings.reach_cells, for_search=False)
        for k in by_submap.get(submap, []):
            measured[k] = _measure(
                settings,
                nodes[constraints[k].node],
                constraints[k],
                drawn[submap],
                tables,
                T_map_submap[submap],
                T_map_node[constraints[k].node],
            )
    return drawn, measured


def _measure(
    settings: LidarSlamSettings,
    node: Keynode,
    constraint: Constraint,
    frozen: FrozenMap,
    tables: MatchTables,
    T_map_submap: np.ndarray,
    T_map_node: np.ndarray,
) -> Constraint:
    """The same constraint from a fresh match that starts at the optimised pose."""
    features = node.scan.features.astype(np.float64)
    guess = se2.between(T_map_submap, T_map_node)
    match = refine(features, node.scan.origin, guess, tables, settings, anneal=(1.5,))
    moved = np.hypot(*(match.T_map_body[:2] - guess[:2]))
    if match.share < settings.loop_share or match.known < settings.loop_known or moved > 0.3:
        return constraint
    match = held_along(without_slip(features, node.scan.origin, match, tables, settings), guess)
    known = match.information if constraint.loop or match.rigid is None else match.rigid
    information = edge_information(known, settings.edge_sigma_m, settings.edge_sigma_rad)
    if not constraint.loop:
        information /= settings.inner_facts
    return Constraint(constraint.submap, constraint.node, match.T_map_body, information, constraint.loop)
