"""Buildings that repeat themselves: is a chunk of scans where it fits, or at a copy of that place?"""

from __future__ import annotations

import math

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.place_search import SearchTarget, search_places
from beamsplat.services.localization.lidar2d.snapshot import Snapshot

MIN_OVERLAP = 0.5
ALIKE_RATIO = 0.85  # places look alike if their scores have this ratio
APART_M = 3.0  # matches farther apart than this are at different places
MAX_EXPECTED_COPIES = 0.2  # unmapped ones, where the drift allows them
AMBIGUOUS_CHI2 = 9.2  # twice the logarithm of 100
SAME_YAW_RAD = math.radians(10.0)


def is_ambiguous(
    matched: np.ndarray,  # float64 [3], pose of the chunk where it fits
    predicted: np.ndarray,  # float64 [3], predicted pose
    sigma_m: float,  # of the prediction
    sigma_rad: float,
    others: list[np.ndarray],  # float64 [3] each, poses at which it fits nearly as well; all in one frame
    area_m2: float,  # of the map
) -> bool:
    """Return whether the chunk may as well be where the building looks the same.

    Look-alike places at a displacement d from each other suggest others at d from the matched one, mapped or
    not. The match is taken only if it is a hundred times as likely by the drift as each of them, and if by
    their density none is to be expected among the places that the drift allows.
    """

    def chi2(pose: np.ndarray) -> float:
        off = se2.between(predicted, pose)
        return float((off[0] ** 2 + off[1] ** 2) / sigma_m**2 + off[2] ** 2 / sigma_rad**2)

    limit, copies = chi2(matched) + AMBIGUOUS_CHI2, 0
    for other in others:
        moved = other[:2] - matched[:2]
        if math.hypot(moved[0], moved[1]) < APART_M:
            continue
        copies += 1
        opposite = np.array([*(matched[:2] - moved), matched[2]])
        parallel = abs(se2.wrap(float(other[2] - matched[2]))) < SAME_YAW_RAD
        if chi2(other) < limit or (parallel and chi2(opposite) < limit):
            return True
    return copies / area_m2 * math.pi * (3.0 * sigma_m) ** 2 > MAX_EXPECTED_COPIES


def look_alikes(
    score: float, features: np.ndarray, origin: np.ndarray, snapshot: Snapshot, without: set[int]
) -> list[np.ndarray]:
    """Return the poses pose_map_chunk [3] at which a chunk of scans fits nearly as well as at its best one.

    The whole map is searched, also where the drift rules the chunk out: that tells how the building repeats.

    Args:
        score: of the best match.
        features: float64 [K, 5], returns of the chunk, see `pose_graph_data.merged_features`.
        origin: float64 [2], the lidar in the frame of the chunk.
        without: ids of the submaps to which the chunk belongs.
    """
    row = {s: i for i, s in enumerate(snapshot.submap_ids)}
    s = snapshot.settings
    found = search_places(
        features, origin, _all_targets(snapshot, without), snapshot.cache, s,
        MIN_OVERLAP, max(s.min_place_score, ALIKE_RATIO * score), s.place_min_inlier_ratio,
    )  # fmt: skip
    return [
        se2.compose(snapshot.pose_map_submap[row[m.submap]], m.match.pose_target_body)
        for m in found
        if m.score >= ALIKE_RATIO * score
    ]


def _all_targets(snapshot: Snapshot, without: set[int]) -> list[SearchTarget]:
    """Return every second finished submap that is not in `without`, to be searched everywhere."""
    targets: list[SearchTarget] = []
    chosen: set[int] = set()
    node_row = {n: i for i, n in enumerate(snapshot.node_ids)}
    for k, submap_id in enumerate(snapshot.submap_ids):
        if submap_id in without or submap_id not in snapshot.frozen or submap_id - 1 in chosen:
            continue
        chosen.add(submap_id)
        path = [node_row[m] for m in snapshot.members[submap_id][::4] if m in node_row]
        positions = se2.transform(
            se2.inverse(snapshot.pose_map_submap[k]), snapshot.pose_map_node[path][:, :2]
        )
        targets.append(
            SearchTarget(submap_id, snapshot.frozen[submap_id], positions, np.zeros(3), math.inf, math.inf)
        )
    step = max(1, math.ceil(len(targets) / snapshot.settings.max_place_targets))
    return targets[::step]
