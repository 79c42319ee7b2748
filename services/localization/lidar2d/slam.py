"""2D lidar SLAM: scans and odometry in; poses, maps and background jobs out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from services.localization.lidar2d import se2
from services.localization.lidar2d.backend import BackEnd, BackgroundJob, JobResult, run_job
from services.localization.lidar2d.frontend import FrontEnd, LocalMap, RawScan
from services.localization.lidar2d.movers import contradicts_free_space, grow_along_beams
from services.localization.lidar2d.nodes import Constraint, Keynode, KeyScan, Submap, edge_information
from services.localization.lidar2d.scan import PreparedScan
from services.localization.lidar2d.settings import LidarSlamSettings
from services.localization.lidar2d.surfel_map import SurfelMap, freeze

NS = 1e-9


@dataclass(frozen=True)
class ScanResult:
    """What one scan gave."""

    stamp_ns: int
    status: str  # "ok", "lost", "relocalizing" or "rejected: reason"
    T_odom_body: np.ndarray  # float64 [3], smooth
    T_map_odom: np.ndarray  # float64 [3], may jump
    covariance: np.ndarray  # float64 [3, 3] of x, y (odom axes), yaw
    moving: np.ndarray  # bool [N] per beam
    points_body: np.ndarray  # float64 [M, 2] deskewed returns
    beams: np.ndarray  # int32 [M] beam of each return
    keynode: bool
    share: float  # share of returns on known surfaces
    job: BackgroundJob | None  # work to run; its result is due before scan `job.apply_at_scan`


@dataclass
class _Active:
    submap: Submap
    local: LocalMap


class LidarSlam:
    """One robot, one lidar. `add_scan` never waits for background work; see `offline.JobRunner`."""

    def __init__(self, settings: LidarSlamSettings, T_body_lidar: np.ndarray) -> None:
        matrix = np.asarray(T_body_lidar)
        self.settings = settings
        self.front = FrontEnd(settings, se2.from_matrix(matrix), matrix.shape == (4, 4) and matrix[2, 2] < 0)
        self.back = BackEnd(settings)
        self.scans = 0
        self._active: list[_Active] = []
        self._last_key: Keynode | None = None
        self._since_job = 0
        self._due: BackgroundJob | None = None
        self._record: list[tuple[int, int, np.ndarray, np.ndarray]] = []

    def add_odometry(self, stamp_ns: int, x_m: float, y_m: float, yaw_rad: float) -> None:
        """A pose of the wheels in their own frame; refused ones are counted in `front.odometry.refused`."""
        self.front.odometry.add(stamp_ns, x_m, y_m, yaw_rad)

    def add_scan(
        self, stamp_ns: int, ranges_m: np.ndarray, angle_min_rad: float, angle_increment_rad: float,
        time_increment_s: float, range_min_m: float, range_max_m: float,
    ) -> ScanResult:  # fmt: skip
        """Match one scan; keynodes enter the map."""
        if self._due is not None and self.scans >= self._due.apply_at_scan:
            raise RuntimeError(f"result of job {self._due.number} is due before scan {self.scans}: call apply() first")
        raw = RawScan(stamp_ns, ranges_m, angle_min_rad, angle_increment_rad, time_increment_s, range_min_m, range_max_m)
        self.scans += 1
        if not self._active:
            return self._first(raw)
        prediction, options = self.front.predict(stamp_ns)
        scan = self.front.prepare(raw, self.front.scan_velocity(raw, prediction.motion))
        local = self._active[0].local
        scan, match, good = self.front.match(raw, scan, prediction, local)
        if good:
            T_odom_body = se2.compose(local.T_odom_map, match.T_map_body)
        else:
            last = self.front.poses[-1]
            T_odom_body = se2.compose(last, prediction.motion) if prediction.source == "wheels" else last
            options = []
        self.front.accept(stamp_ns, T_odom_body, options)
        moving = self._moving(scan, match.T_map_body if good else None)
        information = match.information
        return self._finish_scan(raw, scan, T_odom_body, "ok" if good else "lost", moving, information, match.share)

    def _first(self, raw: RawScan) -> ScanResult:
        scan = self.front.prepare(raw, self.front.scan_velocity(raw, None))
        self.front.accept(raw.stamp_ns, np.zeros(3), [])
        information = np.diag([1e6, 1e6, 1e8])
        return self._finish_scan(raw, scan, np.zeros(3), "ok", np.zeros(len(scan), dtype=bool), information, 1.0)

    def _moving(self, scan: PreparedScan, T_map_body: np.ndarray | None) -> np.ndarray:
        moving = np.zeros(len(scan), dtype=bool)
        if T_map_body is None or len(scan) == 0:
            return moving
        surfels = self._active[0].local.surfels
        seeds = np.empty(len(scan), dtype=bool)
        contradicts_free_space(scan.points_body, T_map_body, surfels.nearest, surfels.means, surfels.hits,
                               surfels.misses, surfels.row0, surfels.col0, surfels.cell_m, seeds)  # fmt: skip
        grow_along_beams(seeds, scan.points_body, scan.beams, 0.15, moving)
        return moving

    def _finish_scan(
        self, raw: RawScan, scan: PreparedScan, T_odom_body: np.ndarray, status: str, moving: np.ndarray,
        information: np.ndarray, share: float,
    ) -> ScanResult:  # fmt: skip
        key = status == "ok" and self._is_key(raw.stamp_ns, T_odom_body)
        if key:
            self._insert(raw.stamp_ns, scan, T_odom_body, moving, information)
        job = self._job()
        per_beam = np.zeros(len(raw.ranges_m), dtype=bool)
        per_beam[scan.beams[moving]] = True
        T_map_odom = self.back.T_map_odom.copy()
        T_key_body = se2.between(self._last_key.T_odom_body, T_odom_body)
        self._record.append((raw.stamp_ns, self._last_key.id, T_key_body, se2.compose(T_map_odom, T_odom_body)))
        covariance = np.linalg.inv(edge_information(information, 0.003, 0.001))
        return ScanResult(raw.stamp_ns, status, T_odom_body, T_map_odom, covariance, per_beam, scan.points_body,
                          scan.beams, key, share, job)  # fmt: skip

    def _is_key(self, stamp_ns: int, T_odom_body: np.ndarray) -> bool:
        if self._last_key is None:
            return True
        s = self.settings
        moved = se2.between(self._last_key.T_odom_body, T_odom_body)
        return (
            math.hypot(moved[0], moved[1]) > s.keynode_distance_m
            or abs(moved[2]) > s.keynode_angle_rad
            or (stamp_ns - self._last_key.stamp_ns) * NS > s.keynode_time_s
        )

    def _insert(
        self, stamp_ns: int, scan: PreparedScan, T_odom_body: np.ndarray, moving: np.ndarray, information: np.ndarray
    ) -> None:
        s = self.settings
        if not self._active or self._active[-1].local.surfels.scans >= s.submap_keynodes:
            if len(self._active) == 2:
                done = self._active.pop(0)
                done.submap.frozen = freeze(done.local.surfels)
            self._active.append(_Active(self.back.start_submap(T_odom_body), LocalMap(T_odom_body, SurfelMap(s))))
        node = Keynode(self.back.next_node_id, stamp_ns, T_odom_body, KeyScan.of(scan, moving))
        edges = []
        for active in self._active:
            T = se2.between(active.local.T_odom_map, T_odom_body)
            turn = np.array([0.0, 0.0, T[2]])
            active.local.surfels.insert(
                se2.transform(T, scan.points_body), se2.transform(turn, scan.tangents), scan.spacing_m,
                se2.transform(T, scan.origin_body[None])[0], ~moving, ~moving,
            )  # fmt: skip
            info = edge_information(information, s.edge_sigma_m, s.edge_sigma_rad) / s.inner_facts
            edges.append(Constraint(active.submap.id, node.id, T, info, False))
        self.back.add_keynode(node, edges)
        self._last_key = node
        self._since_job += 1

    def _job(self) -> BackgroundJob | None:
        if self._since_job < self.settings.job_keynodes or self._due is not None:
            return None
        self._since_job = 0
        snapshot = self.back.snapshot()
        self._due = BackgroundJob(
            snapshot.number, self.scans + self.settings.apply_after_scans, lambda: run_job(snapshot)
        )
        return self._due

    @property
    def due(self) -> BackgroundJob | None:
        """The job that was handed out and not yet applied."""
        return self._due

    def apply(self, result: JobResult) -> None:
        """Take in the result of the job that is due."""
        self.back.apply(result)
        if self._due is not None and self._due.number == result.number:
            self._due = None

    def finish(self, refine_rounds: int = 2) -> None:
        """Final loop closure, refinement and optimisation, inline."""
        if self._due is not None:
            self.apply(self._due.run())
        for active in self._active:
            if active.submap.frozen is None:
                active.submap.frozen = freeze(active.local.surfels)
        before = -1
        while self.back.pending and len(self.back.pending) != before:
            before = len(self.back.pending)
            self.back.apply(run_job(self.back.snapshot()))
        self.back.apply(run_job(self.back.snapshot(), refine_rounds))

    def trajectory(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stamps int64 [N], T_map_body [N, 3] as now known, and as published online [N, 3], of every scan."""
        stamps = np.array([r[0] for r in self._record], dtype=np.int64)
        if len(stamps) == 0:
            return stamps, np.zeros((0, 3)), np.zeros((0, 3))
        base = np.array([self.back.T_map_node[r[1]] for r in self._record])
        relative = np.array([r[2] for r in self._record])
        return stamps, se2.compose_many(base, relative), np.array([r[3] for r in self._record])
