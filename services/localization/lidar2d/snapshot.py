"""The immutable copy of the pose graph on which background jobs work."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap
from beamsplat.services.localization.lidar2d.loop_hypotheses import LoopHypothesis
from beamsplat.services.localization.lidar2d.pose_graph_data import (
    Constraint,
    ConstraintTable,
    TableCache,
    TrajectoryNode,
)
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings


@dataclass(frozen=True)
class Snapshot:
    """All data that a background job reads; it does not change after creation."""

    number: int
    settings: LidarSlamSettings
    nodes: dict[int, TrajectoryNode]
    frozen: dict[int, FrozenMap]
    submap_ids: list[int]
    node_ids: list[int]
    members: dict[int, list[int]]
    pose_map_submap: np.ndarray  # float64 [S, 3]
    pose_map_node: np.ndarray  # float64 [N, 3]
    constraints: list[Constraint]
    table: ConstraintTable
    jobs_since_optimisation: int
    drift_scale2: float  # see DriftScale
    pending: list[int]
    cache: TableCache
    version: int  # counter of the map's optimisations
    unlinked_from: int | None  # first node of a segment that is not connected to the map
    fixed: frozenset[int]  # submaps that are held constant
    restarted: bool  # this segment began with the loading of the map, not with a loss of tracking
    hypotheses: list[LoopHypothesis]  # loop closures that nothing has confirmed yet
