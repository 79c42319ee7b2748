"""2D lidar SLAM: scans and odometry in; poses, map and background jobs out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.active_submaps import ActiveSubmaps
from beamsplat.services.localization.lidar2d.grid_tiles import MapContent
from beamsplat.services.localization.lidar2d.jobs import BackgroundJob, JobResult, run_job
from beamsplat.services.localization.lidar2d.local_trajectory_builder import LocalTrajectoryBuilder
from beamsplat.services.localization.lidar2d.map_records import SavedMap
from beamsplat.services.localization.lidar2d.map_saver import MapSaver
from beamsplat.services.localization.lidar2d.motion_covariance import UNKNOWN, motion_covariance
from beamsplat.services.localization.lidar2d.motion_prediction import MotionPredictor, Prediction
from beamsplat.services.localization.lidar2d.occupancy import OccupancyGrid, render_occupancy
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint
from beamsplat.services.localization.lidar2d.pose_quality import LOST, PoseQuality, rate_pose
from beamsplat.services.localization.lidar2d.relocalization import Relocalization, relocalize_in
from beamsplat.services.localization.lidar2d.scan import PreparedScan, RawScan
from beamsplat.services.localization.lidar2d.scan_matching import Match
from beamsplat.services.localization.lidar2d.self_returns import SelfReturns
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.state import load_state, map_uuid
from beamsplat.services.localization.lidar2d.trajectory_record import TrajectoryRecord
from beamsplat.services.localization.lidar2d.validate import StampGuard, reason_to_reject

# Of the first scan of a segment, which defines the frame of its submap.
FIRST_MATCH = Match(np.zeros(3), np.diag([1e6, 1e6, 1e8]), 1.0, 1.0, 0.0)


@dataclass(frozen=True)
class ScanResult:
    """Result of `add_scan` for one scan: status, poses, dynamic beams and the background job to run."""

    stamp_ns: int
    status: str  # "ok", "lost", "relocalizing" or "rejected: reason"
    pose_odom_body: np.ndarray  # float64 [3], continuous
    pose_map_odom: np.ndarray  # float64 [3], may jump
    covariance: np.ndarray  # float64 [3, 3] of the motion over the last second: x, y (odom axes), yaw
    dynamic: np.ndarray  # bool [N], dynamic-beam mask
    points_body: np.ndarray  # float64 [M, 2] deskewed returns
    beams: np.ndarray  # int32 [M] beam of each return
    inserted: bool  # the scan became a node
    inlier_ratio: float  # returns on surfaces / returns in observed space
    quality: PoseQuality
    job: BackgroundJob | None  # work to be run; its result is due before scan `job.apply_at_scan`


class LidarSlam:
    """2D lidar SLAM of one robot with one lidar.

    `add_scan` never waits for background jobs; `job_runner.JobRunner` runs them.
    """

    def __init__(self, settings: LidarSlamSettings, T_body_lidar: np.ndarray) -> None:
        """Create an empty map; `T_body_lidar` is float64 [4, 4], or a planar pose [3]."""
        matrix = np.asarray(T_body_lidar, dtype=np.float64)
        self.settings = settings
        self.motion = MotionPredictor(settings)
        upside_down = matrix.shape == (4, 4) and matrix[2, 2] < 0
        self.local_builder = LocalTrajectoryBuilder(
            settings, se2.from_matrix(matrix), self.motion, bool(upside_down)
        )
        self.pose_graph = PoseGraph(settings)
        self.active_submaps = ActiveSubmaps(settings, self.pose_graph)
        self.record = TrajectoryRecord()
        self.scans = 0
        self.self_returns = SelfReturns()
        self._stamps = StampGuard()
        self._consecutive_lost = 0
        self._next_link_scan = 0
        # Scans after a gap that wait for the segment to which they belong: stamp and published pose_map_body.
        self._unplaced: list[tuple[int, np.ndarray]] = []
        self.gaps_tied = self.gaps_open = 0  # gaps in tracking, with and without a constraint over them
        self._pending_job: BackgroundJob | None = None

    def add_odometry(self, stamp_ns: int, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Add a pose of the body from wheel odometry, in the frame of the odometry.

        Rejected poses are counted in `motion.odometry.rejected`.
        """
        self.motion.odometry.add(stamp_ns, x_m, y_m, yaw_rad)

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
        """Match one scan to the map; insert it if it passes the motion filter.

        Malformed scans are reported in the status. Raises RuntimeError if the result of a job is overdue.
        """
        if self._pending_job is not None and self.scans >= self._pending_job.apply_at_scan:
            raise RuntimeError(
                f"the result of job {self._pending_job.number} is due: call apply() before scan {self.scans}"
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
            self.motion.restart_clock(stamp_ns)
        measured, raw = raw, self.self_returns.without(raw)
        if not self.motion.poses:
            return self._add_first_scan(raw)
        # 1. predict, 2. deskew, 3. match
        prediction, candidates = self.motion.predict(stamp_ns)
        velocity = self.motion.scan_velocity(raw, prediction.motion)
        scan = self.local_builder.prepare(raw, velocity)
        if len(scan) < self.settings.min_points:
            return self._rejected(raw, f"{len(scan)} returns; at least {self.settings.min_points} are needed")
        scan, match, good = self.local_builder.match(
            raw, scan, velocity, prediction, self.active_submaps.matching_target
        )
        # 4. take the matched pose, or else the wheel odometry
        moved: Prediction | None = None
        if good:
            pose_odom_body = se2.compose(
                self.active_submaps.matching_target.pose_odom_submap, match.pose_target_body
            )
        else:
            moved = self.motion.gap_motion(stamp_ns)
            pose_odom_body = self.motion.poses[-1]
            if moved is not None:
                pose_odom_body = se2.compose(self.motion.last_matched[1], moved.motion)
        if good:
            self._find_self_returns(measured, se2.between(self.motion.poses[-1], pose_odom_body))
        target_yaw_rad = float(self.active_submaps.matching_target.pose_odom_submap[2])
        self.motion.accept(stamp_ns, pose_odom_body, candidates if good else [], velocity, matched=good)
        covariance = self._covariance(match, target_yaw_rad) if good else UNKNOWN
        self._consecutive_lost = 0 if good else self._consecutive_lost + 1
        tie = None
        known = prediction.long_gap and moved is not None and self.motion.can_deskew(raw)
        if not good and (known or self._consecutive_lost >= self.settings.lost_scans):
            tie = self._start_segment(moved, stamp_ns, pose_odom_body)
            match, good = FIRST_MATCH, True
        # 5. dynamic objects, 6. insertion, 7. background job
        return self._insert_scan(raw, scan, pose_odom_body, match, covariance, good, tie)

    def _add_first_scan(self, raw: RawScan) -> ScanResult:
        scan = self.local_builder.prepare(raw, self.motion.scan_velocity(raw, None))
        if len(scan) < self.settings.min_points:
            return self._rejected(raw, f"{len(scan)} returns; at least {self.settings.min_points} are needed")
        self.motion.accept(raw.stamp_ns, np.zeros(3), [])
        self.pose_graph.uuid = self.pose_graph.uuid or map_uuid(raw.stamp_ns, raw.ranges_m)
        covariance = self._covariance(FIRST_MATCH, 0.0)
        return self._insert_scan(raw, scan, np.zeros(3), FIRST_MATCH, covariance, True)

    def _covariance(self, match: Match, target_yaw_rad: float) -> np.ndarray:
        return motion_covariance(match, target_yaw_rad, self.motion.stamps, self.motion.poses, self.settings)

    def _start_segment(
        self, moved: Prediction | None, stamp_ns: int, pose_odom_body: np.ndarray
    ) -> Constraint | None:
        """Finish the active submaps and start a segment of the trajectory with the next inserted scan.

        Returns the constraint over the gap: the motion by the wheels since the last good scan. Without it
        (None) the segment is a separate map until its place in the map is recognised.
        """
        self._consecutive_lost = 0
        before = self.active_submaps.matching_target_id
        self.active_submaps.close()
        set_back = self.motion.start_segment(stamp_ns, pose_odom_body)
        if moved is None:
            self.gaps_open += 1
            # A robot does not leave its map because its clock is set: as after a restart.
            self.pose_graph.start_segment(restarted=set_back)
            self._next_link_scan = self.scans
            return None
        self.gaps_tied += 1
        submap = self.pose_graph.submaps[before]
        information = np.diag([moved.sigma_m**-2, moved.sigma_m**-2, moved.sigma_rad**-2])
        pose = se2.between(submap.pose_odom_submap, pose_odom_body)
        return Constraint(before, self.pose_graph.next_node_id, pose, information, False)

    def _insert_scan(
        self, raw: RawScan, scan: PreparedScan, pose_odom_body: np.ndarray, match: Match,
        covariance: np.ndarray, good: bool, tie: Constraint | None = None,
    ) -> ScanResult:  # fmt: skip
        """Detect dynamic objects, insert the scan, create a background job if due; return the result."""
        dynamic = (
            self.active_submaps.dynamic_returns(scan, pose_odom_body)
            if good
            else np.zeros(len(scan), dtype=bool)
        )
        inserted = good and self.active_submaps.insert(
            raw.stamp_ns, scan, pose_odom_body, dynamic, match, self.motion.reckoning.take_recovery()
        )
        if tie is not None and inserted:
            self.pose_graph.constraints.append(tie)
        job = self._next_job()
        per_beam = np.zeros(len(raw.ranges_m), dtype=bool)
        per_beam[scan.beams[dynamic]] = True
        pose_map_odom = self.pose_graph.pose_map_odom.copy()
        published = se2.compose(pose_map_odom, pose_odom_body)
        self._unplaced.append((raw.stamp_ns, published))
        if good or not self.motion.is_in_gap(raw.stamp_ns):
            self._place_scans(raw.stamp_ns, pose_odom_body)
        status = "lost" if not good else "ok" if self.pose_graph.unlinked_from is None else "relocalizing"
        return ScanResult(
            raw.stamp_ns,
            status,
            pose_odom_body,
            pose_map_odom,
            covariance.copy(),
            per_beam,
            scan.points_body,
            scan.beams,
            inserted,
            match.inlier_ratio,
            rate_pose(covariance, match, self.motion.reckoning.degenerate, self.settings) if good else LOST,
            job,
        )

    def _find_self_returns(self, raw: RawScan, motion: np.ndarray) -> None:
        """Look for returns on the robot itself; what is found is saved with the map."""
        if self.self_returns.observe(raw, motion):
            self.pose_graph.self_returns_m = self.self_returns.range_m.astype(np.float32)

    def _place_scans(self, stamp_ns: int, pose_odom_body: np.ndarray) -> None:
        """Record this scan, and those before it that had no pose yet, relative to the last node."""
        last = self.active_submaps.last_node
        assert last is not None  # the first accepted scan is a node
        for earlier_ns, published in self._unplaced:
            pose = pose_odom_body
            if earlier_ns != stamp_ns:
                moved = self.motion.odometry.motion_after_gap(earlier_ns, stamp_ns)
                pose = se2.compose(pose, se2.inverse(moved))
            self.record.add(earlier_ns, last.id, se2.between(last.pose_odom_body, pose), published)
        self._unplaced.clear()

    def _rejected(self, raw: RawScan, reason: str) -> ScanResult:
        pose_odom_body = self.motion.poses[-1].copy() if self.motion.poses else np.zeros(3)
        count = len(raw.ranges_m) if isinstance(raw.ranges_m, np.ndarray) and raw.ranges_m.ndim == 1 else 0
        return ScanResult(
            raw.stamp_ns,
            f"rejected: {reason}",
            pose_odom_body,
            self.pose_graph.pose_map_odom.copy(),
            UNKNOWN.copy(),
            np.zeros(count, dtype=bool),
            np.zeros((0, 2)),
            np.zeros(0, dtype=np.int32),
            False,
            0.0,
            LOST,
            self._next_job(),
        )

    # ---- background jobs --------------------------------------------------------------------------

    def _next_job(self) -> BackgroundJob | None:
        """Return a background job if one is due, else None."""
        s = self.settings
        searching = self.pose_graph.unlinked_from is not None and self.scans >= self._next_link_scan
        if self._pending_job is not None or not self.pose_graph.nodes:
            return None
        if self.active_submaps.nodes_since_job < (1 if searching else s.job_nodes):
            return None
        self.active_submaps.nodes_since_job = 0
        self._next_link_scan = self.scans + s.link_every_scans
        snapshot = self.pose_graph.snapshot()
        self._pending_job = BackgroundJob(
            snapshot.number, self.scans + s.apply_after_scans, lambda: run_job(snapshot)
        )
        return self._pending_job

    def apply(self, result: JobResult) -> None:
        """Apply the result of the background job, and remove redundant submaps at intervals."""
        self.pose_graph.apply(result)
        if self._pending_job is not None and self._pending_job.number == result.number:
            self._pending_job = None
        if result.number % self.settings.trim_every_jobs == 0 or self.pose_graph.fixed:
            self.pose_graph.trim(self.active_submaps.active_ids)

    def finish(self, refine_rounds: int = 4) -> None:
        """Do the final loop closure, refinement and optimisation inline; mapping may continue afterwards."""
        if self._pending_job is not None:
            self.apply(self._pending_job.run())
        if not self.pose_graph.nodes:
            return
        if self._unplaced:  # the recording ends within a gap
            self._place_scans(self._unplaced[-1][0], self.motion.poses[-1])
        self.active_submaps.freeze_active()
        before = -1
        while self.pose_graph.pending and len(self.pose_graph.pending) != before:
            before = len(self.pose_graph.pending)
            self.pose_graph.apply(run_job(self.pose_graph.snapshot()))
        self.pose_graph.apply(
            run_job(self.pose_graph.snapshot(), 0 if self.pose_graph.fixed else refine_rounds)
        )

    # ---- results ----------------------------------------------------------------------------------

    def trajectory(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return stamps int64 [N], optimised poses and published poses float64 [N, 3] of all N scans.

        The poses are pose_map_body.
        """
        return (
            self.record.stamps_ns,
            self.record.optimised(self.pose_graph.all_node_poses()),
            self.record.online,
        )

    def anchors(self) -> dict[int, np.ndarray]:
        """Return pose_map_anchor float64 [3] by anchor id; the anchors are the submaps."""
        return {i: s.pose_map_submap.copy() for i, s in self.pose_graph.submaps.items()}

    def grid(self, resolution_m: float = 0.05) -> OccupancyGrid:
        """Return the occupancy grid of the whole map."""
        content = self.map_content()
        finished = [(frozen, pose) for _, frozen, pose in content.finished]
        return render_occupancy([*finished, *content.growing], resolution_m)

    def map_content(self) -> MapContent:
        """Return what the grid is drawn from; only the counts of the active submaps are copied."""
        submaps = self.pose_graph.submaps.values()
        finished = [(s.id, s.frozen, s.pose_map_submap) for s in submaps if s.frozen is not None]
        return MapContent(finished, self.active_submaps.count_grids())

    def relocalize(
        self,
        ranges_m: np.ndarray,
        angle_min_rad: float,
        angle_increment_rad: float,
        range_min_m: float,
        range_max_m: float,
    ) -> Relocalization:
        """Return the pose of one scan in the map, without a prediction.

        Raises ValueError for an empty map or a malformed scan.
        """
        raw = RawScan(0, ranges_m, angle_min_rad, angle_increment_rad, 0.0, range_min_m, range_max_m)
        reason = reason_to_reject(raw)
        if reason:
            raise ValueError(reason)
        scan = self.local_builder.prepare(raw, np.zeros(3))
        return self.relocalize_features(scan.features(), scan.origin_body)

    def relocalize_features(self, features: np.ndarray, origin: np.ndarray) -> Relocalization:
        """Return the pose of a scan (features float64 [K, 5], lidar at `origin` [2]) in the map."""
        return relocalize_in(self.pose_graph, features, origin)

    def save(self, folder: Path) -> None:
        """Write the map and the trajectory to `folder`; mapping may continue afterwards."""
        MapSaver(folder, self.settings).save(self.saved())

    def saved(self) -> SavedMap:
        """Return the map and the trajectory for a `MapSaver`; scans and grids are not copied."""
        return SavedMap.of(self.pose_graph, self.record)

    @staticmethod
    def load(
        folder: Path, settings: LidarSlamSettings, T_body_lidar: np.ndarray, localize_only: bool = False
    ) -> LidarSlam:
        """Load a saved map to continue it; the status is "relocalizing" until the pose in this map is found.

        With `localize_only` the saved map is not changed. Raises UserError.
        """
        slam = LidarSlam(settings, T_body_lidar)
        slam.pose_graph, extra = load_state(folder, settings)
        if slam.pose_graph.self_returns_m is not None:
            slam.self_returns.restore(slam.pose_graph.self_returns_m)
        slam.active_submaps = ActiveSubmaps(settings, slam.pose_graph)
        slam.record = TrajectoryRecord() if localize_only else TrajectoryRecord.of(extra)
        slam.pose_graph.start_segment(restarted=True)
        if localize_only:
            slam.pose_graph.fixed = frozenset(slam.pose_graph.submaps)
        return slam
