"""Lidar SLAM as a node: scans and wheels in; smooth pose, correction, anchors, movers and grid out."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import check_can_write
from beamsplat.common.geometry.transforms import se2_to_se3, se3_to_se2
from beamsplat.common.messages import (
    Anchors,
    Correction,
    Grid,
    MovingBeams,
    Odometry,
    Rig,
    Scan,
    WheelOdometry,
)
from beamsplat.common.runtime.node import Input, Job, Node, Outputs
from beamsplat.services.localization.lidar2d.occupancy import OccupancyGrid
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam, ScanResult
from beamsplat.services.localization.lidar2d.state import MANIFEST, MapStateError, read_manifest, write_state

log = logging.getLogger("beamsplat.localization")

_LOST_SUBMAPS = 1000  # more than can have been begun since the state that a restart goes on from


class LidarLocalizationConfig(NodeConfig):
    """The SLAM itself needs no tuning: what differs between lidars comes with the scans."""

    grid_every_scans: Annotated[int, Field(ge=1)] = 50
    grid_resolution_m: Annotated[float, Field(gt=0.0, le=1.0)] = 0.05
    save: Path | None = None  # folder for map, trajectory and state, written at the end of the data
    resume: Path | None = None  # folder of a saved state: the robot finds its place in it and maps on
    keep_every_s: Annotated[float, Field(gt=0.0)] = 10.0  # live: a copy, for a restart after a crash


class LidarLocalization(Node):
    """The robot's pose from its lidar, with wheel odometry if there is any.

    A process that dies costs the seconds until its successor has found its place in the map that it kept.
    """

    name = "localization"
    Config = LidarLocalizationConfig
    # The calibration is merged by stamp with the scans: whether it is there must not depend on luck.
    inputs = (Input("rig", "every"), "lidar/scan", "wheel/odometry")
    outputs = (
        "localization/odometry", "localization/correction", "localization/anchors", "localization/movers",
        "localization/grid",
    )  # fmt: skip

    def check_resources(self) -> None:
        """Check that the state to resume can be read, and that the new one can be written."""
        if self.config.resume is not None:
            try:
                read_manifest(self.config.resume / MANIFEST)
            except MapStateError as error:
                raise UserError(f"resume = {error}") from error
        if self.config.save is not None:
            check_can_write(self.config.save, "save")

    def configure(self) -> None:
        self._slam: LidarSlam | None = None
        self._said: np.ndarray | None = None  # T_map_odom as last published
        self._optimisations = 0
        self._stamp_ns = 0
        self._drawn: OccupancyGrid | None = None
        self._named = ""  # the map whose name was said
        self._kept_ns: int | None = None  # when the last state was kept for a restart
        self._keeping = False
        self._spare = None if self.live_settings is None else self.live_settings.run_dir / "localization"
        if self._spare is not None and not self.live_settings.resume:  # of another drive
            shutil.rmtree(self._spare, ignore_errors=True)
        if self.config.resume is not None:
            try:
                read_manifest(self.config.resume / MANIFEST)
            except MapStateError as error:
                raise UserError(f"localization.resume: {error}") from error

    def on_rig(self, rig: Rig) -> Outputs:
        """Where the lidar sits. A second calibration would bend the map: it is rejected, and said."""
        if rig.lidar is None:
            log.error("the calibration has no lidar: scans cannot be used")
        elif self._slam is None:
            self._stamp_ns = rig.stamp_ns
            self._slam = self._begin(rig.lidar.T_body_lidar)
            yield from self._name_map()
        else:
            log.warning("a new calibration is ignored: restart the node to use it")

    def _begin(self, T_body_lidar: np.ndarray) -> LidarSlam:
        crashed = self._spare is not None and (self._spare / MANIFEST).is_file()
        folder = self._spare if crashed else self.config.resume
        if folder is None:
            return LidarSlam(LidarSlamSettings(), T_body_lidar)
        try:
            slam = LidarSlam.load(folder, LidarSlamSettings(), T_body_lidar)
        except MapStateError as error:
            if not crashed:
                raise UserError(f"localization.resume: {error}") from error
            log.error("begins a new map: %s", error)
            return LidarSlam(LidarSlamSettings(), T_body_lidar)
        if crashed:
            slam.pose_graph.reserve_submap_ids(_LOST_SUBMAPS)
        log.info("goes on from %s: %d submaps", folder, len(slam.anchors()))
        return slam

    def on_wheel_odometry(self, odometry: WheelOdometry) -> Outputs:
        if self._slam is not None:
            self._slam.add_odometry(odometry.stamp_ns, *se3_to_se2(odometry.T_odom_body).tolist())
        return iter(())

    def on_lidar_scan(self, scan: Scan) -> Outputs:
        """One pose a scan; background work and a new grid now and then."""
        if self._slam is None:
            yield "localization/odometry", _unusable(scan.stamp_ns, "no calibration yet")
            return
        result = self._slam.add_scan(
            scan.stamp_ns, scan.ranges_m, scan.angle_min_rad, scan.angle_increment_rad,
            scan.time_increment_s, scan.range_min_m, scan.range_max_m,
        )  # fmt: skip
        self._stamp_ns = scan.stamp_ns
        yield from self._name_map()
        yield "localization/odometry", _odometry(result)
        yield "localization/movers", MovingBeams(stamp_ns=scan.stamp_ns, moving=result.dynamic)
        yield from self._correction(scan.stamp_ns, result.pose_map_odom)
        if result.job is not None:
            # Its result is due before the scan with number `apply_at_scan`; the next one is `scans`.
            after = result.job.apply_at_scan - self._slam.scans + 1
            yield Job("optimise", result.job.run, after=after, of="lidar/scan")
        yield from self._keep_state(scan.stamp_ns, result.status == "ok")
        if self._slam.scans % self.config.grid_every_scans == 0:
            yield from self._draw_grid()

    def on_job_optimise(self, result: object) -> Outputs:
        """A background optimisation is taken in: the map moves, the smooth pose does not."""
        self._slam.apply(result)
        self._optimisations += 1
        yield from self._map_moved()

    def _keep_state(self, stamp_ns: int, placed: bool) -> Outputs:
        """Now and then a copy goes to the disk, in the background, for whoever is started after a crash."""
        if self._spare is None or self._keeping or not placed:
            return
        if self._kept_ns is None or abs(stamp_ns - self._kept_ns) >= self.config.keep_every_s * 1e9:
            self._kept_ns, self._keeping = stamp_ns, True
            folder, state = self._spare, self._slam.packed()

            def keep() -> str:
                try:
                    write_state(folder, state)
                except OSError as error:
                    return f"{folder}: {reason(error)}"
                return ""

            yield Job("keep", keep)

    def on_job_keep(self, fault: str) -> Outputs:
        """The copy is on the disk, or could not be written."""
        self._keeping = False
        self.detail = f"no copy of the map for a restart: {fault}" if fault else ""
        return iter(())

    def drain(self) -> Outputs:
        """Last loop closures and optimisation, the final grid, and the files asked for."""
        if self._slam is None or not self._slam.anchors():
            return  # nothing usable came: there is no map
        self._slam.finish()
        self._optimisations += 1
        yield from self._map_moved()
        yield from self._draw_grid()
        if self.config.save is not None:
            self._slam.save(self.config.save)
            log.info("map and state saved to %s", self.config.save)

    def _map_moved(self) -> Outputs:
        yield from self._correction(self._stamp_ns, self._slam.pose_graph.pose_map_odom)
        yield from self._anchors()

    def _name_map(self) -> Outputs:
        """Which map it is, before the first pose in it: what hangs on anchors of two must not mix."""
        if self._slam.pose_graph.uuid != self._named:
            yield from self._anchors()

    def _anchors(self) -> Outputs:
        self._named = self._slam.pose_graph.uuid
        anchors = self._slam.anchors()
        T_map_anchor = se2_to_se3(np.array(list(anchors.values())).reshape(-1, 3))
        yield (
            "localization/anchors",
            Anchors(
                stamp_ns=self._stamp_ns, anchor_ids=np.array(list(anchors), dtype=np.int64),
                T_map_anchor=T_map_anchor, optimisation=self._optimisations,
                map_uuid=self._slam.pose_graph.uuid,
            ),
        )  # fmt: skip

    def _correction(self, stamp_ns: int, pose_map_odom: np.ndarray) -> Outputs:
        """Says `T_map_odom` when it has changed: it is latched."""
        if self._said is None or not np.array_equal(self._said, pose_map_odom):
            self._said = pose_map_odom.copy()
            yield (
                "localization/correction",
                Correction(
                    stamp_ns=stamp_ns, T_map_odom=se2_to_se3(pose_map_odom), optimisation=self._optimisations
                ),
            )

    def _draw_grid(self) -> Outputs:
        """The occupancy grid as it is now, and the region in which it differs from the one before."""
        grid = self._slam.grid(self.config.grid_resolution_m)
        changed = _changed(self._drawn, grid)
        self._drawn = grid
        yield (
            "localization/grid",
            Grid(
                stamp_ns=self._stamp_ns, resolution_m=grid.resolution_m,
                origin_m=np.array([grid.origin_x_m, grid.origin_y_m]), occupancy=grid.values, changed=changed,
            ),
        )  # fmt: skip


def _changed(before: OccupancyGrid | None, grid: OccupancyGrid) -> tuple[int, int, int, int]:
    """Bounding box (row0, column0, row1, column1) of the cells that differ; all, if the grid has moved."""
    rows, columns = grid.values.shape
    same_place = before is not None and before.values.shape == grid.values.shape and (
        before.origin_x_m == grid.origin_x_m and before.origin_y_m == grid.origin_y_m
    )  # fmt: skip
    if not same_place:
        return 0, 0, rows, columns
    differs = np.argwhere(before.values != grid.values)
    if not len(differs):
        return 0, 0, 0, 0
    (row0, column0), (row1, column1) = differs.min(axis=0).tolist(), differs.max(axis=0).tolist()
    return row0, column0, row1 + 1, column1 + 1


def _odometry(result: ScanResult) -> Odometry:
    status, _, detail = result.status.partition(": ")
    return Odometry(
        stamp_ns=result.stamp_ns, T_odom_body=se2_to_se3(result.pose_odom_body), covariance=result.covariance,
        status=status, detail=detail,
    )  # fmt: skip


def _unusable(stamp_ns: int, why: str) -> Odometry:
    return Odometry(
        stamp_ns=stamp_ns,
        T_odom_body=np.eye(4),
        covariance=np.full((3, 3), np.nan),
        status="rejected",
        detail=why,
    )
