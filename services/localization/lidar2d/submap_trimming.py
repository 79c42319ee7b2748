"""Trimming of redundant submaps, so that the map stays bounded in lifelong operation.

Of the submaps that cover the same place, the two oldest (which carry the anchors of early keyframes) and the
two newest (the current state of the environment) remain.
"""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np

from beamsplat.services.localization.lidar2d.pose_graph_data import Submap

CELL_M = 1.5  # edge of the square cells
HEADINGS = 4  # number of heading sectors
MIN_COVERED_RATIO = 0.9  # fraction of a submap's nodes that other submaps must cover


def redundant_submaps(
    submaps: dict[int, Submap],
    pose_map_node: dict[int, np.ndarray],
    protected: set[int],
    min_covering: int,
) -> list[int]:
    """Return the ids of submaps that can be removed, ascending.

    Nearly every node of such a submap must be covered by at least `min_covering` other submaps, with nodes in
    the same place and heading; at least two of them must be older and two newer.
    """
    cell_of = {n: _pose_cell(pose) for n, pose in pose_map_node.items()}
    covered_by: dict[tuple[int, int, int], set[int]] = defaultdict(set)
    for submap in submaps.values():
        if submap.frozen is not None:
            for n in submap.members:
                covered_by[cell_of[n]].add(submap.id)
    redundant: set[int] = set()
    for submap_id in sorted(submaps):
        submap = submaps[submap_id]
        if submap.frozen is None or submap_id in protected or not submap.members:
            continue
        covered = 0
        for n in submap.members:
            others = covered_by[cell_of[n]] - redundant - {submap_id}
            # Consecutive submaps share half of their scans: they are not independent.
            others = {o for o in others if abs(o - submap_id) > 1}
            older = sum(o < submap_id for o in others)
            covered += len(others) >= min_covering and older >= 2 and len(others) - older >= 2
        if covered >= MIN_COVERED_RATIO * len(submap.members):
            redundant.add(submap_id)
    return sorted(redundant)


def _pose_cell(pose_map_body: np.ndarray) -> tuple[int, int, int]:
    """Return the indices (x, y, heading sector) of the cell of a pose float64 [3]."""
    heading = math.floor((pose_map_body[2] + math.pi / HEADINGS) / (2 * math.pi / HEADINGS)) % HEADINGS
    return math.floor(pose_map_body[0] / CELL_M), math.floor(pose_map_body[1] / CELL_M), heading
