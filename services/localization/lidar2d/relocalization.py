"""Where am I in a known map, without any guess: branch and bound over the whole map, then evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.branch_bound import Pyramid, branch_and_bound, build_pyramid
from beamsplat.services.localization.lidar2d.loops import evidence
from beamsplat.services.localization.lidar2d.matching import Match, refine
from beamsplat.services.localization.lidar2d.nodes import Keynode
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import MatchTables, SurfelMap, freeze

SEARCH_RETURNS = 120
CANDIDATES = 40
REFINE_FIRST = 6  # Gauss-Newton steps every candidate gets before the best few get all of them


@dataclass(frozen=True)
class GlobalMap:
    """All keynodes of a map in one grid in the map frame."""

    tables: MatchTables
    pyramid: Pyramid
    centre_m: np.ndarray  # float64 [2]
    half_extent_m: float


@dataclass(frozen=True)
class Relocalization:
    """The best place for a scan. Below a confidence of 0.5 it should not be used."""

    T_map_body: np.ndarray  # float64 [3]
    confidence: float  # 0..1: how well the scan fits, times how much better than anywhere else
    covariance: np.ndarray  # float64 [3, 3]
    share: float  # returns on known surfaces / returns in known space
    known: float
    rival: float  # evidence of the best other place / evidence of the best


def build_global_map(
    settings: LidarSlamSettings, nodes: list[Keynode], T_map_node: list[np.ndarray]
) -> GlobalMap:
    """Draw every keynode into one map. Raises ValueError if there is none."""
    if not nodes:
        raise ValueError("the map is empty: drive and map first, or load a saved map")
    surfels = SurfelMap(settings)
    for node, T in zip(nodes, T_map_node):
        still = ~node.scan.moving
        surfels.insert(
            se2.transform(T, node.scan.points.astype(np.float64)),
            se2.transform(np.array([0.0, 0.0, T[2]]), node.scan.tangents.astype(np.float64)),
            node.scan.spacing_m.astype(np.float64),
            se2.transform(T, node.scan.origin[None])[0],
            still,
            still,
            matchable=False,
        )
    tables = freeze(surfels).tables(settings.reach_cells)
    positions = np.array([T[:2] for T in T_map_node])
    low, high = positions.min(axis=0), positions.max(axis=0)
    # A body can only be where it has been, give or take a few metres.
    half = 0.5 * float((high - low).max()) + 3.0
    pyramid = build_pyramid(tables.field, tables.row0, tables.col0, tables.cell_m)
    return GlobalMap(tables, pyramid, 0.5 * (low + high), half)


def relocalize_in(
    world: GlobalMap,
    features: np.ndarray,  # float64 [K, 5]
    origin: np.ndarray,  # float64 [2]
    settings: LidarSlamSettings,
) -> Relocalization:
    """Global search for one scan (or a merged chunk)."""
    if len(features) < settings.min_points:
        return _nowhere(world)
    centre = np.array([world.centre_m[0], world.centre_m[1], 0.0])
    subset = features[:: max(1, len(features) // SEARCH_RETURNS)]
    found = branch_and_bound(subset, centre, world.pyramid, world.half_extent_m, math.pi, 0.4, keep=0.85)
    rough = [
        refine(features, origin, T, world.tables, settings, iterations=REFINE_FIRST)
        for _, T in found[:CANDIDATES]
    ]
    rough.sort(key=lambda m: -evidence(m))
    matches = [
        refine(features, origin, m.T_map_body, world.tables, settings, anneal=(1.5,)) for m in rough[:6]
    ]
    matches.sort(key=lambda m: -evidence(m))
    if not matches or evidence(matches[0]) <= 0.0:
        return _nowhere(world)
    best = matches[0]
    rivals = [evidence(m) for m in [*matches[1:], *rough] if _apart(m, best)]
    rival = max([*rivals, 0.0]) / evidence(best)
    fit = min(max((best.share - 0.6) / 0.25, 0.0), 1.0) * min(best.known / 0.7, 1.0)
    confidence = fit * min(max((1.0 - rival) / 0.1, 0.0), 1.0)
    covariance = np.linalg.inv(best.information + np.diag([0.1, 0.1, 4.0]))
    return Relocalization(best.T_map_body, confidence, covariance, best.share, best.known, rival)


def _apart(a: Match, b: Match) -> bool:
    turned = abs(math.remainder(a.T_map_body[2] - b.T_map_body[2], 2.0 * math.pi))
    return bool(np.hypot(*(a.T_map_body[:2] - b.T_map_body[:2])) > 0.3 or turned > math.radians(10.0))


def _nowhere(world: GlobalMap) -> Relocalization:
    T = np.array([world.centre_m[0], world.centre_m[1], 0.0])
    return Relocalization(T, 0.0, np.diag([1e4, 1e4, 10.0]), 0.0, 0.0, 1.0)
