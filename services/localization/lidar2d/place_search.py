"""Place recognition: one chunk of scans against many submaps at once, by branch and bound (Hess et al. 2016).

Each submap is searched in its own frame, so that the result does not depend on how well the map as a whole is
put together. A search reads one coarse pyramid per submap, which is computed once and kept in a cache.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.branch_bound import branch_and_bound
from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap
from beamsplat.services.localization.lidar2d.loops import match_score
from beamsplat.services.localization.lidar2d.pose_graph_data import TableCache
from beamsplat.services.localization.lidar2d.scan_matching import Match, refine
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings

SEARCH_RETURNS = 120  # returns of the chunk that branch and bound uses
SEARCH_STEP_RAD = math.radians(1.0)
KEEP = 0.9  # poses of one submap within this ratio of its best score are candidates
RIVAL = 0.85  # poses below this ratio of the best score of all submaps are left out
SEARCH_LIMITS = (0.8, 0.6)  # of the score, tried one after the other
NEAR_PATH_M = 2.5  # a chunk is searched within this distance of the poses of the submap's scans
CANDIDATES_PER_SUBMAP = 3
CANDIDATES = 16  # poses over all submaps that are refined
SAME_PLACE_M, SAME_PLACE_RAD = 0.4, math.radians(10.0)


@dataclass(frozen=True)
class SearchTarget:
    """A submap to search, with the predicted pose of the chunk in it and the window around the prediction."""

    submap: int
    frozen: FrozenMap
    path_m: np.ndarray  # float64 [N, 2], positions of the submap's scans in its frame
    pose_submap_chunk: np.ndarray  # float64 [3], predicted
    window_m: float  # inf: anywhere
    window_rad: float


@dataclass(frozen=True)
class PlaceMatch:
    """A pose of the chunk in a submap, refined with all its returns."""

    submap: int
    match: Match

    @property
    def score(self) -> float:
        return match_score(self.match)


def _window(target: SearchTarget) -> tuple[np.ndarray, float]:
    """Return centre [3] and half width (m) of the square that is searched in a submap."""
    low, high = target.path_m.min(axis=0), target.path_m.max(axis=0)
    centre, half = 0.5 * (low + high), 0.5 * float((high - low).max()) + NEAR_PATH_M
    if target.window_m >= half:
        return np.array([*centre, target.pose_submap_chunk[2]]), half
    return target.pose_submap_chunk, target.window_m


def search_places(
    features: np.ndarray,  # float64 [K, 5]
    origin: np.ndarray,  # float64 [2], the lidar in the frame of the chunk
    targets: list[SearchTarget],
    cache: TableCache,
    settings: LidarSlamSettings,
    min_overlap: float,
    min_score: float,
    min_inlier_ratio: float,
) -> list[PlaceMatch]:
    """Return the distinct poses at which a chunk of scans fits into a submap, best first.

    Args:
        features: returns of the chunk, see `pose_graph_data.merged_features`.
        min_overlap: matches with a smaller ratio of returns in observed space are left out.
        min_score: poses with a smaller mean likelihood in the coarse search are left out.
        min_inlier_ratio: matches with a smaller inlier ratio are left out.
    """
    if len(features) < settings.min_points:
        return []
    count = min(len(features), SEARCH_RETURNS)
    subset = features[np.linspace(0, len(features) - 1, count).astype(np.int64)]
    candidates = _coarse_search(subset, targets, cache, min_score)
    candidates.sort(key=lambda c: -c[0])
    matches: list[PlaceMatch] = []
    # Sorted by submap, because the cache holds few of the large match tables.
    for _, index, pose in sorted(candidates[:CANDIDATES], key=lambda c: (c[1], -c[0])):
        target = targets[index]
        tables = cache.tables(target.submap, target.frozen, for_search=False)
        match = refine(features, origin, pose, tables, settings)
        fits = match.overlap >= min_overlap and match.inlier_ratio >= min_inlier_ratio
        if fits and _is_in_window(target, match):
            matches.append(PlaceMatch(target.submap, match))
    matches.sort(key=lambda m: -m.score)
    distinct: list[PlaceMatch] = []
    for m in matches:
        if not any(m.submap == o.submap and _same_pose(m.match, o.match) for o in distinct):
            distinct.append(m)
    return distinct


def _coarse_search(
    points: np.ndarray, targets: list[SearchTarget], cache: TableCache, min_score: float
) -> list[tuple[float, int, np.ndarray]]:
    """Return (score, index of the target, pose [3]) of the candidates, also of some that are no rivals.

    Branch and bound is much faster with a high limit. If the best pose is above it by 1 / RIVAL, a search
    with a lower limit would find no other candidates.
    """
    candidates: list[tuple[float, int, np.ndarray]] = []
    for limit in (*(t for t in SEARCH_LIMITS if t > min_score), min_score):
        candidates, best = [], 0.0
        for index, target in enumerate(targets):
            centre, half = _window(target)
            found = branch_and_bound(
                points, centre, cache.pyramid(target.submap, target.frozen), half,
                min(target.window_rad, math.pi), max(limit, RIVAL * best), keep=KEEP,
                min_step_rad=SEARCH_STEP_RAD,
            )  # fmt: skip
            best = max([best, *(score for score, _ in found)])
            candidates += [(score, index, pose) for score, pose in found[:CANDIDATES_PER_SUBMAP]]
        if RIVAL * best >= limit:
            break
    return candidates


def _is_in_window(target: SearchTarget, match: Match) -> bool:
    """Return whether a match is as near to the prediction as it must be; the search covers whole submaps."""
    off = se2.between(target.pose_submap_chunk, match.pose_target_body)
    return math.hypot(off[0], off[1]) <= target.window_m and abs(off[2]) <= target.window_rad


def _same_pose(a: Match, b: Match) -> bool:
    off = se2.between(a.pose_target_body, b.pose_target_body)
    return math.hypot(off[0], off[1]) < SAME_PLACE_M and abs(off[2]) < SAME_PLACE_RAD
