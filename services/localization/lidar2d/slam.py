"""2D lidar SLAM: scans and odometry in; poses, maps and background jobs out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.backend import BackEnd
from beamsplat.services.localization.lidar2d.frontend import FrontEnd, RawScan, exp_twist
from beamsplat.services.localization.lidar2d.jobs import BackgroundJob, JobResult, run_job
from beamsplat.services.localization.lidar2d.mapping import LocalMapper
from beamsplat.services.localization.lidar2d.matching import Match
from beamsplat.services.localization.lidar2d.nodes import edge_information
from beamsplat.services.localization.lidar2d.occupancy import CountGrid, OccupancyGrid, render
from beamsplat.services.localization.lidar2d.record import TrajectoryRecord
from beamsplat.services.localization.lidar2d.relocalization import (
    GlobalMap,
    Relocalization,
    build_global_map,
    relocalize_in,
)
from beamsplat.services.localization.lidar2d.scan import PreparedScan
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.state import (
    PackedMap,
    load_state,
    map_uuid,
    packed_state,
    write_state,
)
from beamsplat.services.localization.lidar2d.validate import StampGuard, reason_to_reject

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
    share: float  # share of returns in known space that lie on known surfaces
    job: BackgroundJob | None  # work to run; its result is due before scan number `job.apply_at_scan`


@dataclass(frozen=True)
class PoseAt:
    """Pose at any stamp; both factors as of now."""

    T_map_odom: np.ndarray  # float64 [3]
    T_odom_body: np.ndarray  # float64 [3]
    extrapolated_s: float  # 0 between scans


class LidarSlam:
    """One robot, one lidar. `add_scan` never waits for background work; `offline.JobRunner` runs the jobs."""

    def __init__(self, settings: LidarSlamSettings, T_body_lidar: np.ndarray) -> None:
        matrix = np.asarray(T_body_lidar, dtype=np.float64)
        self.settings = settings
        self.front = FrontEnd(settings, se2.from_matrix(matrix), matrix.shape == (4, 4) and matrix[2, 2] < 0)
        self.back = BackEnd(settings)
        self.mapper = LocalMapper(settings, self.back)
        self.record = TrajectoryRecord()
        self.scans = 0
        self._stamps = StampGuard()
        self._lost_run = 0
        self._next_link_scan = 0
        self._due: BackgroundJob | None = None

    def add_odometry(self, stamp_ns: int, x_m: float, y_m: float, yaw_rad: float) -> None:
        """A pose of the wheels in their own frame; refused ones are counted in `front.odometry.refused`."""
        self.front.odometry.add(stamp_ns, x_m, y_m, yaw_rad)

    def add_scan(
        self,
        stamp_ns: int,
        ranges_m: np.ndarray,
        angle_min_rad: float,
        angle_increment_rad: float,
        time_increment_s: float,
        range_min_m: float,
        range_max_m: float,
    ) -> ScanResult:
        """Match one scan; keynodes enter the map. Raises RuntimeError if a job's result is overdue."""
        if self._due is not None and self.scans >= self._due.apply_at_scan:
            raise RuntimeError(
                f"the result of job {self._due.number} is due: call apply() before scan {self.scans}"
            )
        raw = RawScan(
            stamp_ns, ranges_m, angle_min_rad, angle_increment_rad, time_increment_s, range_min_m, range_max_m
        )
        self.scans += 1
        reason = reason_to_reject(raw)
        restarted = False
        if not reason:
            reason, restarted = self._stamps.check(stamp_ns)
        if reason:
            return self._rejected(raw, reason)
        if restarted:
            self.front.restart_clock(stamp_ns)
        if not self.front.poses:
            return self._first(raw)
        # 1. predict, 2. deskew, 3. match
        prediction, options = self.front.predict(stamp_ns)
        scan = self.front.prepare(raw, self.front.scan_velocity(raw, prediction.motion))
        if len(scan) < self.settings.min_points:
            return self._rejected(raw, f"{len(scan)} returns, {self.settings.min_points} are needed")
        scan, match, good = self.front.match(raw, scan, prediction, self.mapper.matched)
        # 4. take the pose, or hold on to what the wheels say
        if good:
            T_odom_body = se2.compose(self.mapper.matched.T_odom_map, match.T_map_body)
        else:
            last = self.front.poses[-1]
            T_odom_body = se2.compose(last, prediction.motion) if prediction.source == "wheels" else last
        self.front.accept(stamp_ns, T_odom_body, options if good else [])
        self._lost_run = 0 if good else self._lost_run + 1
        if self._lost_run >= self.settings.lost_scans or (self._lost_run and prediction.blind):
            self._start_segment(raw.stamp_ns, scan, T_odom_body)
            good = True
        # 5. movers, 6. map, 7. background work
        return self._map(raw, scan, T_odom_body, match, good)

    def _first(self, raw: RawScan) -> ScanResult:
        scan = self.front.prepare(raw, self.front.scan_velocity(raw, None))
        if len(scan) < self.settings.min_points:
            return self._rejected(raw, f"{len(scan)} returns, {self.settings.min_points} are needed")
        self.front.accept(raw.stamp_ns, np.zeros(3), [])
        self.back.uuid = self.back.uuid or map_uuid(raw.stamp_ns, raw.ranges_m)
        return self._map(
            raw, scan, np.zeros(3), Match(np.zeros(3), np.diag([1e6, 1e6, 1e8]), 1.0, 1.0, 0.0), True
        )

    def _start_segment(self, stamp_ns: int, scan: PreparedScan, T_odom_body: np.ndarray) -> None:
        self._lost_run = 0
        self.mapper.close()
        self.back.start_segment()
        self._next_link_scan = self.scans

    def _map(
        self, raw: RawScan, scan: PreparedScan, T_odom_body: np.ndarray, match: Match, good: bool
    ) -> ScanResult:
        moving = self.mapper.moving(scan, T_odom_body) if good else np.zeros(len(scan), dtype=bool)
        key = good and self.mapper.insert(
            raw.stamp_ns, scan, T_odom_body, moving, match, self.front.reckoning.regained()
        )
        job = self._job()
        per_beam = np.zeros(len(raw.ranges_m), dtype=bool)
        per_beam[scan.beams[moving]] = True
        T_map_odom = self.back.T_map_odom.copy()
        last = self.mapper.last_key
        self.record.add(
            raw.stamp_ns,
            last.id,
            se2.between(last.T_odom_body, T_odom_body),
            se2.compose(T_map_odom, T_odom_body),
        )
        covariance = np.linalg.inv(edge_information(match.information, 0.003, 0.001))
        status = "lost" if not good else "ok" if self.back.unlinked_from is None else "relocalizing"
        return ScanResult(
            raw.stamp_ns,
            status,
            T_odom_body,
            T_map_odom,
            covariance,
            per_beam,
            scan.points_body,
            scan.beams,
            key,
            match.share,
            job,
        )

    def _rejected(self, raw: RawScan, reason: str) -> ScanResult:
        T_odom_body = self.front.poses[-1].copy() if self.front.poses else np.zeros(3)
        count = len(raw.ranges_m) if isinstance(raw.ranges_m, np.ndarray) and raw.ranges_m.ndim == 1 else 0
        return ScanResult(
            raw.stamp_ns,
            f"rejected: {reason}",
            T_odom_body,
            self.back.T_map_odom.copy(),
            np.diag([1.0, 1.0, 0.1]),
            np.zeros(count, dtype=bool),
            np.zeros((0, 2)),
            np.zeros(0, dtype=np.int32),
            False,
            0.0,
            self._job(),
        )

    # ---- background work --------------------------------------------------------------------------

    def _job(self) -> BackgroundJob | None:
        s = self.settings
        searching = self.back.unlinked_from is not None and self.scans >= self._next_link_scan
        if self._due is not None or not self.back.nodes:
            return None
        if not searching and self.mapper.keynodes_since_job < s.job_keynodes:
            return None
        self.mapper.keynodes_since_job = 0
        self._next_link_scan = self.scans + s.link_every_scans
        snapshot = self.back.snapshot()
        self._due = BackgroundJob(
            snapshot.number, self.scans + s.apply_after_scans, lambda: run_job(snapshot)
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
        if result.number % self.settings.trim_every_jobs == 0 or self.back.fixed:
            self.back.trim(self.mapper.active_ids)

    def finish(self, refine_rounds: int = 4) -> None:
        """Final loop closure, refinement and optimisation, inline; mapping may go on afterwards."""
        if self._due is not None:
            self.apply(self._due.run())
        if not self.back.nodes:
            return
        self.mapper.freeze_active()
        before = -1
        while self.back.pending and len(self.back.pending) != before and self.back.unlinked_from is None:
            before = len(self.back.pending)
            self.back.apply(run_job(self.back.snapshot()))
        self.back.apply(run_job(self.back.snapshot(), 0 if self.back.fixed else refine_rounds))

    # ---- answers ----------------------------------------------------------------------------------

    def pose_at(self, stamp_ns: int) -> PoseAt | None:
        """Between scans interpolated; up to `extrapolate_s` beyond the newest by its velocity; else None."""
        stamps, poses = self.front.stamps, self.front.poses
        if not stamps or stamp_ns < stamps[0]:
            return None
        ahead_s = (stamp_ns - stamps[-1]) * NS
        if ahead_s > self.settings.extrapolate_s:
            return None
        if ahead_s >= 0.0:
            T = se2.compose(poses[-1], exp_twist(self.front.velocity(), ahead_s))
            return PoseAt(self.back.T_map_odom.copy(), T, ahead_s)
        i = int(np.searchsorted(np.array(stamps), stamp_ns, side="right"))
        f = (stamp_ns - stamps[i - 1]) / (stamps[i] - stamps[i - 1])
        T = se2.compose(poses[i - 1], f * se2.between(poses[i - 1], poses[i]))
        return PoseAt(self.back.T_map_odom.copy(), T, 0.0)

    def trajectory(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stamps int64 [N], T_map_body [N, 3] as now known, and as published online [N, 3], of every scan."""
        return self.record.stamps_ns, self.record.optimised(self.back.all_node_poses()), self.record.online

    def anchors(self) -> dict[int, np.ndarray]:
        """T_map_anchor float64 [3] by id: the submaps."""
        return {i: s.T_map_submap.copy() for i, s in self.back.submaps.items()}

    def grid(self, resolution_m: float = 0.05) -> OccupancyGrid:
        """Occupancy of everything seen so far."""
        frozen = [(s.frozen, s.T_map_submap) for s in self.back.submaps.values() if s.frozen is not None]
        grids = [CountGrid(*f.counts(), f.row0, f.col0, f.cell_m, T) for f, T in frozen]
        return render(grids + self.mapper.count_grids(), resolution_m)

    def relocalize(
        self,
        ranges_m: np.ndarray,
        angle_min_rad: float,
        angle_increment_rad: float,
        range_min_m: float,
        range_max_m: float,
    ) -> Relocalization:
        """Where one scan was taken, without any guess. Raises ValueError for an empty map or a bad scan."""
        raw = RawScan(0, ranges_m, angle_min_rad, angle_increment_rad, 0.0, range_min_m, range_max_m)
        reason = reason_to_reject(raw)
        if reason:
            raise ValueError(reason)
        scan = self.front.prepare(raw, np.zeros(3))
        return relocalize_in(self.world(), scan.features(), scan.origin_body, self.settings)

    def world(self) -> GlobalMap:
        """The map relocalization searches; drawn once per state of the map (about a second)."""
        back = self.back
        known = [n for n in back.nodes if back.unlinked_from is None or n < back.unlinked_from]

        def build() -> GlobalMap:
            nodes, T_map_node = [back.nodes[n] for n in known], [back.T_map_node[n] for n in known]
            return build_global_map(self.settings, nodes, T_map_node)

        return back.cache.world((back.optimisations, len(known)), build)

    def save(self, folder: Path) -> None:
        """Write the state; mapping may go on."""
        write_state(folder, self.packed())

    def packed(self) -> PackedMap:
        """Copies of the state as it is now."""
        return self.mapper.with_frozen(lambda: packed_state(self.back, self.record.arrays()))

    @staticmethod
    def load(
        folder: Path, settings: LidarSlamSettings, T_body_lidar: np.ndarray, localize_only: bool = False
    ) -> LidarSlam:
        """A saved map to go on with; the first scans find their place in it ("relocalizing").

        With `localize_only` the saved map stays as it is. Raises MapStateError.
        """
        slam = LidarSlam(settings, T_body_lidar)
        slam.back, extra = load_state(folder, settings)
        slam.mapper = LocalMapper(settings, slam.back)
        slam.record = TrajectoryRecord() if localize_only else TrajectoryRecord.of(extra)
        slam.back.start_segment()
        if localize_only:
            slam.back.fixed = frozenset(slam.back.submaps)
        return slam
