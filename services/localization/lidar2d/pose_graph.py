"""The back end: owns nodes, submaps and constraints; creates snapshots and applies job results."""

from __future__ import annotations

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.drift_model import DriftScale
from beamsplat.services.localization.lidar2d.jobs import JobResult
from beamsplat.services.localization.lidar2d.loop_hypotheses import LoopHypothesis
from beamsplat.services.localization.lidar2d.pose_graph_data import (
    Constraint,
    ConstraintTable,
    Submap,
    TableCache,
    TrajectoryNode,
)
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.snapshot import Snapshot
from beamsplat.services.localization.lidar2d.submap_trimming import redundant_submaps


class PoseGraph:
    """State of the pose graph between background jobs."""

    def __init__(self, settings: LidarSlamSettings) -> None:
        self.settings = settings
        # Ranges of the robot's own surfaces by angle, float32 [self_returns.BINS]; None: none were found.
        self.self_returns_m: np.ndarray | None = None
        self.uuid = ""  # of the map; derived from its first scan and kept over restarts
        self.nodes: dict[int, TrajectoryNode] = {}
        self.submaps: dict[int, Submap] = {}
        self.constraints: list[Constraint] = []
        self.pose_map_node: dict[int, np.ndarray] = {}
        self.pose_map_odom = np.zeros(3)
        self.pending: list[int] = []
        self.cache = TableCache(settings.reach_cells)
        self._table = ConstraintTable()
        self.drift_scale = DriftScale()
        self._jobs_since_optimisation = 0  # jobs that added loop closures without moving anything
        self.loop_closures = 0
        self.optimisations = 0
        self.unlinked_from: int | None = None
        self.hypotheses: list[LoopHypothesis] = []
        self._restarted = False
        self.fixed: frozenset[int] = frozenset()
        # Trimmed nodes: the remaining node they are attached to, and the pose (x, y, yaw) relative to it.
        self.trimmed_nodes: dict[int, tuple[int, float, float, float]] = {}
        self._jobs = 0
        self._next_node = self._next_submap = 0

    def start_submap(self, pose_odom_submap: np.ndarray) -> Submap:
        """Add an empty submap at a pose in the odom frame and return it."""
        submap = Submap(
            self._next_submap, pose_odom_submap, se2.compose(self.pose_map_odom, pose_odom_submap)
        )
        self._next_submap += 1
        self.submaps[submap.id] = submap
        return submap

    def resume_numbering(self) -> None:
        """Continue the numbering of nodes and submaps after the ids of a loaded map."""
        self._next_node = 1 + max([*self.nodes, *self.trimmed_nodes], default=-1)
        self._next_submap = 1 + max(self.submaps, default=-1)

    def reserve_submap_ids(self, count: int) -> None:
        """Skip `count` submap ids: a crashed process may have published ids that the loaded map lacks."""
        self._next_submap += count

    def start_segment(self, restarted: bool = False) -> None:
        """Start a trajectory segment; it is connected to the map when its place in the map is recognised.

        `restarted`: the map was loaded; otherwise tracking was lost.
        """
        if self.nodes:
            self.unlinked_from = self._next_node
            self._restarted = restarted

    def add_node(self, node: TrajectoryNode, edges: list[Constraint]) -> None:
        """Add a node with its constraints (`edges`) to the submaps into which its scan was inserted."""
        self.nodes[node.id] = node
        self._next_node = node.id + 1
        self.pose_map_node[node.id] = se2.compose(self.pose_map_odom, node.pose_odom_body)
        self.constraints += edges
        for edge in edges:
            self.submaps[edge.submap].members.append(node.id)
        # Matches of neighbouring scans have the same errors.
        if node.id % self.settings.loop_every_nodes == 0:
            self.pending.append(node.id)

    def main_submaps(self) -> set[int]:
        """Return the ids of the submaps that constraints connect with the first submap."""
        row = {s: i for i, s in enumerate(self.submaps)}
        label = list(range(len(row)))

        def root(i: int) -> int:
            while label[i] != i:
                label[i] = label[label[i]]
                i = label[i]
            return i

        first: dict[int, int] = {}  # node -> row of a submap
        for c in self.constraints:
            a, b = root(row[c.submap]), root(first.setdefault(c.node, row[c.submap]))
            label[max(a, b)] = min(a, b)
        return {s for s, i in row.items() if root(i) == 0}

    @property
    def next_node_id(self) -> int:
        return self._next_node

    def snapshot(self) -> Snapshot:
        """Return an immutable copy for a background job."""
        self._jobs += 1
        return Snapshot(
            self._jobs,
            self.settings,
            dict(self.nodes),
            {i: s.frozen for i, s in self.submaps.items() if s.frozen is not None},
            list(self.submaps),
            list(self.nodes),
            {i: list(s.members) for i, s in self.submaps.items()},
            np.array([s.pose_map_submap for s in self.submaps.values()]).reshape(-1, 3),
            np.array(list(self.pose_map_node.values())).reshape(-1, 3),
            list(self.constraints),
            self._table,
            self._jobs_since_optimisation,
            self.drift_scale.scale2,
            list(self.pending),
            self.cache,
            self.optimisations,
            self.unlinked_from,
            self.fixed,
            self._restarted,
            list(self.hypotheses),
        )

    def apply(self, result: JobResult) -> None:
        """Apply the result of a background job: poses, constraints and rebuilt submaps.

        Nodes and submaps that were added since the snapshot move with the last optimised node.
        """
        newest = max(result.pose_map_node, default=result.newest_node)
        newer = [n for n in self.pending if n > newest]
        self.pending = result.still_pending + newer
        self.hypotheses = result.hypotheses
        if result.drift_ratio2 is not None:
            self.drift_scale.add(result.drift_ratio2)
        if result.linked and self.unlinked_from is not None and newest >= self.unlinked_from:
            self.unlinked_from = None
        self.loop_closures += result.loops_found
        if result.constraints is not None:
            self.constraints = result.constraints + self.constraints[result.snapshot_constraints :]
            self._jobs_since_optimisation += 1
        if result.pose_map_node:
            self._move(result, newest)
            self._jobs_since_optimisation = 0
            self.optimisations += 1

    def _move(self, result: JobResult, newest: int) -> None:
        self.pose_map_odom = se2.compose(
            result.pose_map_node[newest], se2.inverse(self.nodes[newest].pose_odom_body)
        )
        for i, submap in self.submaps.items():
            moved = result.pose_map_submap.get(i)
            submap.pose_map_submap = (
                moved if moved is not None else se2.compose(self.pose_map_odom, submap.pose_odom_submap)
            )
        for i, node in self.nodes.items():
            moved = result.pose_map_node.get(i)
            self.pose_map_node[i] = (
                moved if moved is not None else se2.compose(self.pose_map_odom, node.pose_odom_body)
            )
        for i, frozen in result.frozen.items():
            self.submaps[i].frozen = frozen

    def trim(self, active: set[int]) -> list[int]:
        """Remove redundant submaps (never the submaps `active`); return the ids of the removed submaps."""
        s = self.settings
        if self.unlinked_from is not None:
            return []
        if self.fixed:  # pure localization: keep only the last two of the new submaps
            own = [i for i in self.submaps if i not in self.fixed and i not in active]
            gone = own[: max(0, len(own) - 2)]
        else:
            gone = redundant_submaps(self.submaps, self.pose_map_node, active, s.min_covering_submaps)
        for submap_id in gone:
            self._remove(submap_id)
        return gone

    def _remove(self, submap_id: int) -> None:
        members = set(self.submaps.pop(submap_id).members)
        self.constraints = [c for c in self.constraints if c.submap != submap_id]
        inner = {m for s in self.submaps.values() for m in s.members if m in members}
        orphans = sorted(members - inner)
        if not orphans:
            return
        gone = set(orphans)
        self.constraints = [c for c in self.constraints if c.node not in gone]
        left = np.array([n for n in self.nodes if n not in gone], dtype=np.int64)
        poses = np.array([self.pose_map_node[int(n)] for n in left])
        for n in orphans:
            anchor = int(left[np.argmin(np.hypot(*(poses[:, :2] - self.pose_map_node[n][:2]).T))])
            self.trimmed_nodes[n] = (
                anchor,
                *se2.between(self.pose_map_node[anchor], self.pose_map_node[n]).tolist(),
            )
        for n in orphans:
            del self.nodes[n], self.pose_map_node[n]
        self.pending = [n for n in self.pending if n not in gone]

    def all_node_poses(self) -> dict[int, np.ndarray]:
        """Return pose_map_node of all nodes, including the trimmed ones."""
        poses = dict(self.pose_map_node)
        for n in self.trimmed_nodes:
            chain, k = [], n
            while k not in poses:
                chain.append(k)
                k = self.trimmed_nodes[k][0]
            for k in reversed(chain):
                anchor, *relative = self.trimmed_nodes[k]
                poses[k] = se2.compose(poses[anchor], np.array(relative))
        return poses
