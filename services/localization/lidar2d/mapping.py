"""The two submaps being filled: which scans enter them, and what moves in them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.backend import BackEnd
from beamsplat.services.localization.lidar2d.frontend import LocalMap
from beamsplat.services.localization.lidar2d.matching import Match
from beamsplat.services.localization.lidar2d.movers import contradicts_free_space, grow_along_beams
from beamsplat.services.localization.lidar2d.nodes import (
    Constraint,
    Keynode,
    KeyScan,
    Submap,
    edge_information,
    link_information,
)
from beamsplat.services.localization.lidar2d.occupancy import CountGrid
from beamsplat.services.localization.lidar2d.scan import PreparedScan
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import SurfelMap, freeze

NS = 1e-9
Result = TypeVar("Result")


@dataclass
class _Active:
    submap: Submap
    local: LocalMap


class LocalMapper:
    """Every keynode goes into two submaps; the older of them is what scans are matched to."""

    def __init__(self, settings: LidarSlamSettings, back: BackEnd) -> None:
        self.settings = settings
        self.back = back
        self.last_key: Keynode | None = None
        self.keynodes_since_job = 0
        self._active: list[_Active] = []
        self._cut = False

    @property
    def matched(self) -> LocalMap:
        """The map the next scan is matched to."""
        return self._active[0].local

    @property
    def active_ids(self) -> set[int]:
        """Submaps still being filled."""
        return {a.submap.id for a in self._active}

    def moving(self, scan: PreparedScan, T_odom_body: np.ndarray) -> np.ndarray:
        """Returns on things that were not there before, bool [M]."""
        moving = np.zeros(len(scan), dtype=bool)
        if not self._active:
            return moving
        local = self._active[0].local
        surfels, seeds = local.surfels, np.empty(len(scan), dtype=bool)
        contradicts_free_space(
            scan.points_body,
            se2.between(local.T_odom_map, T_odom_body),
            surfels.nearest,
            surfels.means,
            surfels.hits,
            surfels.misses,
            surfels.row0,
            surfels.col0,
            surfels.cell_m,
            seeds,
        )
        grow_along_beams(seeds, scan.points_body, scan.beams, 0.15, moving)
        return moving

    def insert(
        self,
        stamp_ns: int,
        scan: PreparedScan,
        T_odom_body: np.ndarray,
        moving: np.ndarray,
        match: Match,
        cut: bool = False,
    ) -> bool:
        """Put the scan into the active submaps if it adds anything (motion filter).

        A `cut` ends the older submap early: what comes after a blind stretch hangs together, but only loosely
        on what was before, and within one submap nothing could bend.
        """
        self._cut = self._cut or cut
        if self._active and not self._is_key(stamp_ns, T_odom_body):
            return False
        s = self.settings
        scans = self._active[-1].local.surfels.scans if self._active else 0
        if not self._active or scans >= s.submap_keynodes or (self._cut and scans >= s.least_keynodes):
            self._cut = False
            if len(self._active) == 2:
                done = self._active.pop(0)
                done.submap.frozen = freeze(done.local.surfels)
                self._active[0].local.surfels.make_matchable()
            self._active.append(
                _Active(self.back.start_submap(T_odom_body), LocalMap(T_odom_body, SurfelMap(s)))
            )
        node = Keynode(self.back.next_node_id, stamp_ns, T_odom_body, KeyScan.of(scan, moving))
        # Scans in a row slip together if they slip: in their own submap they stay together.
        rigid = match.information if match.rigid is None else match.rigid
        matched = edge_information(rigid, s.edge_sigma_m, s.edge_sigma_rad)
        edges = []
        for active in self._active:
            active.submap.frozen = None  # what was frozen for a last optimisation goes on growing
            T = se2.between(active.local.T_odom_map, T_odom_body)
            active.local.surfels.insert(
                se2.transform(T, scan.points_body),
                se2.transform(np.array([0.0, 0.0, T[2]]), scan.tangents),
                scan.spacing_m,
                se2.transform(T, scan.origin_body[None])[0],
                ~moving,
                ~moving,
                matchable=active is self._active[0],
            )
            info = matched if active is self._active[0] else link_information(match.information, s)
            edges.append(Constraint(active.submap.id, node.id, T, info, False))
        self.back.add_keynode(node, edges)
        self.last_key = node
        self.keynodes_since_job += 1
        return True

    def _is_key(self, stamp_ns: int, T_odom_body: np.ndarray) -> bool:
        s = self.settings
        moved = se2.between(self.last_key.T_odom_body, T_odom_body)
        return (
            math.hypot(moved[0], moved[1]) > s.keynode_distance_m
            or abs(moved[2]) > s.keynode_angle_rad
            or not 0.0 <= (stamp_ns - self.last_key.stamp_ns) * NS <= s.keynode_time_s
        )

    def close(self) -> None:
        """Finish the active submaps; the next keynode starts new ones."""
        for active in self._active:
            active.submap.frozen = freeze(active.local.surfels)
        self._active = []

    def freeze_active(self) -> None:
        """Let the active submaps take part in loop closure as they are; they go on being filled."""
        for active in self._active:
            active.submap.frozen = freeze(active.local.surfels)

    def with_frozen(self, work: Callable[[], Result]) -> Result:
        """What `work` gives while the active submaps look finished (saving)."""
        growing = [active for active in self._active if active.submap.frozen is None]
        for active in growing:
            active.submap.frozen = freeze(active.local.surfels)
        try:
            return work()
        finally:
            for active in growing:
                active.submap.frozen = None

    def count_grids(self) -> list[CountGrid]:
        """Hits and misses of the submaps that are not frozen."""
        return [
            CountGrid(
                a.local.surfels.hits,
                a.local.surfels.misses,
                a.local.surfels.row0,
                a.local.surfels.col0,
                a.local.surfels.cell_m,
                a.submap.T_map_submap,
            )
            for a in self._active
            if a.submap.frozen is None
        ]
