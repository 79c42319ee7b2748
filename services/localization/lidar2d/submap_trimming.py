"""Keeping the map bounded: submaps of places that are covered many times over are taken out.

The two oldest submaps of a place stay (what hangs on them stays put) and so do the newest (the world
changes); those in between go.
"""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np

from beamsplat.services.localization.lidar2d.pose_graph_data import Submap

CELL_M = 1.5
HEADINGS = 4
MIN_COVERED_RATIO = 0.9  # share of a submap's keynodes whose place others cover


def redundant_submaps(
    submaps: dict[int, Submap], pose_map_node: dict[int, np.ndarray], protected: set[int], copies: int
) -> list[int]:
    """Ids of submaps that may go: nearly everywhere they were, at least `copies` other submaps have been too,
    looking the same way, two of them older and two of them newer."""
    place_of = {n: _pose_cell(pose) for n, pose in pose_map_node.items()}
    seen_by: dict[tuple[int, int, int], set[int]] = defaultdict(set)
    for submap in submaps.values():
        if submap.frozen is not None:
            for n in submap.members:
                seen_by[place_of[n]].add(submap.id)
    gone: set[int] = set()
    for submap_id in sorted(submaps):
        submap = submaps[submap_id]
        if submap.frozen is None or submap_id in protected or not submap.members:
            continue
        covered = 0
        for n in submap.members:
            others = seen_by[place_of[n]] - gone - {submap_id}
            # Neighbours share half their scans: they are no second look.
            others = {o for o in others if abs(o - submap_id) > 1}
            older = sum(o < submap_id for o in others)
            covered += len(others) >= copies and older >= 2 and len(others) - older >= 2
        if covered >= MIN_COVERED_RATIO * len(submap.members):
            gone.add(submap_id)
    return sorted(gone)


def _pose_cell(pose_map_body: np.ndarray) -> tuple[int, int, int]:
    heading = math.floor((pose_map_body[2] + math.pi / HEADINGS) / (2 * math.pi / HEADINGS)) % HEADINGS
    return math.floor(pose_map_body[0] / CELL_M), math.floor(pose_map_body[1] / CELL_M), heading
