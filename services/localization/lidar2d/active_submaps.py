"""The two submaps that new scans are inserted into, and the detection of dynamic objects in them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.dynamic_objects import contradicts_free_space, grow_along_beams
from beamsplat.services.localization.lidar2d.frozen_map import freeze
from beamsplat.services.localization.lidar2d.local_trajectory_builder import LocalMap
from beamsplat.services.localization.lidar2d.node_scan import NodeScan
from beamsplat.services.localization.lidar2d.occupancy import CountGrid
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.pose_graph_data import (
    Constraint,
    Submap,
    TrajectoryNode,
    edge_information,
    second_submap_information,
)
from beamsplat.services.localization.lidar2d.scan import PreparedScan
from beamsplat.services.localization.lidar2d.scan_matching import Match
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import SurfelMap

NS = 1e-9


@dataclass
class _Active:
    """An active submap: its entry in the pose graph and its growing local map."""

    submap: Submap
    local: LocalMap


class ActiveSubmaps:
    """The one or two submaps into which new scans are inserted, as in Cartographer.

    Every trajectory node is inserted into both; scans are matched to the older one.
    """

    def __init__(self, settings: LidarSlamSettings, pose_graph: PoseGraph) -> None:
        self.settings = settings
        self.pose_graph = pose_graph
        self.last_node: TrajectoryNode | None = None
        self.nodes_since_job = 0
        self._active: list[_Active] = []
        self._force_new_submap = False

    @property
    def matching_target(self) -> LocalMap:
        """Return the local map that the next scan is matched to: the older active submap."""
        return self._active[0].local

    @property
    def matching_target_id(self) -> int:
        """Return the id of the older active submap."""
        return self._active[0].submap.id

    @property
    def active_ids(self) -> set[int]:
        """Return the ids of the active submaps."""
        return {a.submap.id for a in self._active}

    def dynamic_returns(self, scan: PreparedScan, pose_odom_body: np.ndarray) -> np.ndarray:
        """Return a mask bool [M]: returns on dynamic objects (in space that earlier scans observed free)."""
        dynamic = np.zeros(len(scan), dtype=bool)
        if not self._active:
            return dynamic
        local = self._active[0].local
        surfels, seeds = local.surfels, np.empty(len(scan), dtype=bool)
        contradicts_free_space(
            scan.points_body,
            se2.between(local.pose_odom_submap, pose_odom_body),
            surfels.nearest,
            surfels.means,
            surfels.hits,
            surfels.misses,
            surfels.row0,
            surfels.col0,
            surfels.cell_m,
            seeds,
        )
        grow_along_beams(seeds, scan.points_body, scan.beams, 0.15, dynamic)
        return dynamic

    def insert(
        self,
        stamp_ns: int,
        scan: PreparedScan,
        pose_odom_body: np.ndarray,
        dynamic: np.ndarray,
        match: Match,
        force_new_submap: bool = False,
    ) -> bool:
        """Insert the scan into the active submaps if it passes the motion filter; return True if inserted.

        Args:
            dynamic: bool [M], returns on dynamic objects; they are not inserted.
            match: match of the scan, whose information becomes the information of the constraints.
            force_new_submap: start a new submap early. The caller sets it after a stretch with an
                unobservable direction (corridor): later poses are consistent with each other, but uncertain
                relative to earlier ones. The pose graph can move submaps, but not scans within a submap.
        """
        self._force_new_submap = self._force_new_submap or force_new_submap
        if self._active and not self._passes_motion_filter(stamp_ns, pose_odom_body):
            return False
        s = self.settings
        scans = self._active[-1].local.surfels.scans if self._active else 0
        if (
            not self._active
            or scans >= s.submap_nodes
            or (self._force_new_submap and scans >= s.min_submap_nodes)
        ):
            self._force_new_submap = False
            if len(self._active) == 2:
                done = self._active.pop(0)
                done.submap.frozen = freeze(done.local.surfels)
                self._active[0].local.surfels.make_matchable()
            self._active.append(
                _Active(self.pose_graph.start_submap(pose_odom_body), LocalMap(pose_odom_body, SurfelMap(s)))
            )
        node = TrajectoryNode(
            self.pose_graph.next_node_id, stamp_ns, pose_odom_body, NodeScan.of(scan, dynamic)
        )
        # Consecutive scans share errors along an unobservable direction, so within their own submap the
        # relative poses keep the full information.
        full = match.information if match.full_information is None else match.full_information
        matched = edge_information(full, s.edge_sigma_m, s.edge_sigma_rad)
        edges = []
        for active in self._active:
            active.submap.frozen = None  # discard a temporary freeze: the submap grows again
            pose = se2.between(active.local.pose_odom_submap, pose_odom_body)
            active.local.surfels.insert(
                se2.transform(pose, scan.points_body),
                se2.transform(np.array([0.0, 0.0, pose[2]]), scan.tangents),
                scan.spacing_m,
                se2.transform(pose, scan.origin_body[None])[0],
                ~dynamic,
                ~dynamic,
                matchable=active is self._active[0],
            )
            info = matched if active is self._active[0] else second_submap_information(match.information, s)
            edges.append(Constraint(active.submap.id, node.id, pose, info, False))
        self.pose_graph.add_node(node, edges)
        self.last_node = node
        self.nodes_since_job += 1
        return True

    def _passes_motion_filter(self, stamp_ns: int, pose_odom_body: np.ndarray) -> bool:
        """Return whether the motion or the time since the last node is large enough for a new one."""
        s = self.settings
        last = self.last_node
        assert last is not None  # there are active submaps
        moved = se2.between(last.pose_odom_body, pose_odom_body)
        return (
            math.hypot(moved[0], moved[1]) > s.motion_filter_distance_m
            or abs(moved[2]) > s.motion_filter_angle_rad
            or not 0.0 <= (stamp_ns - last.stamp_ns) * NS <= s.motion_filter_time_s
        )

    def close(self) -> None:
        """Finish the active submaps; the next trajectory node starts new submaps."""
        for active in self._active:
            active.submap.frozen = freeze(active.local.surfels)
        self._active = []

    def freeze_active(self) -> None:
        """Freeze the current state of the active submaps for loop closure; they continue to grow."""
        for active in self._active:
            active.submap.frozen = freeze(active.local.surfels)

    def count_grids(self) -> list[tuple[CountGrid, np.ndarray]]:
        """Return copies of the hits and misses of the active submaps that are not frozen, and their poses."""
        return [
            (
                CountGrid(
                    a.local.surfels.hits.copy(),
                    a.local.surfels.misses.copy(),
                    a.local.surfels.row0,
                    a.local.surfels.col0,
                    a.local.surfels.cell_m,
                ),
                a.submap.pose_map_submap,
            )
            for a in self._active
            if a.submap.frozen is None
        ]
