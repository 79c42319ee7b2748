"""Lidar SLAM node: scans and wheel odometry in; pose, correction, anchors, dynamic-beam mask and grid out."""

from __future__ import annotations

import logging
import shutil
import threading
from pathlib import Path
from typing import Annotated, cast

import numpy as np
from pydantic import Field

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import check_can_write
from beamsplat.common.geometry.transforms import se2_to_se3, se3_to_se2
from beamsplat.common.mapfiles.grid_tiles import TILE_CELLS
from beamsplat.common.messages import (
    Anchors,
    Correction,
    GridTile,
    MovingBeams,
    Odometry,
    Rig,
    Scan,
    WheelOdometry,
)
from beamsplat.common.runtime.node import Input, Job, Node, Outputs
from beamsplat.common.status import TrackingStatus
from beamsplat.services.localization.lidar2d.grid_tiles import GridTiles, Place
from beamsplat.services.localization.lidar2d.jobs import JobResult
from beamsplat.services.localization.lidar2d.map_saver import MapSaver
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam, ScanResult
from beamsplat.services.localization.lidar2d.state import MANIFEST, read_manifest
from beamsplat.services.localization.lidar2d.warm import warm

log = logging.getLogger("beamsplat.localization")

_REPORT_EVERY_SCANS = 50  # of what was found out about the sensors
_RESERVED_SUBMAP_IDS = 1000  # upper bound of the submaps started between the last checkpoint and a crash
_FINISH_S = 1.5  # for the final optimisation of a process that must stop: it is killed after 5 s
_GRID_AFTER_SCANS = 25  # a drawing of the grid is published exactly this many scans after its start, or fewer


class LidarLocalizationConfig(NodeConfig):
    """Configuration; the SLAM needs no tuning, because scans contain the properties of the lidar."""

    grid_every_scans: Remote[Annotated[int, Field(ge=1)]] = 50
    grid_resolution_m: Annotated[float, Field(gt=0.0, le=1.0)] = 0.05
    save: Path | None = None  # folder for map, trajectory and state, written at the end of the data
    resume: Path | None = None  # folder of a saved state to continue; the robot relocalizes in it
    keep_every_s: Annotated[float, Field(gt=0.0)] = 10.0  # live: interval of the checkpoints


class LidarLocalization(Node):
    """Localization service by 2D lidar SLAM, with wheel odometry where it is available.

    In live operation it writes checkpoints of the map. After a crash, the restarted process loads the last
    checkpoint and relocalizes in this map, which takes a few seconds.
    """

    name = "localization"
    Config = LidarLocalizationConfig
    config: LidarLocalizationConfig
    # "every": the calibration is merged with the scans by stamp, so that runs are reproducible.
    inputs = (Input("rig", "every"), "lidar/scan", "wheel/odometry")
    outputs = (
        "localization/odometry", "localization/correction", "localization/anchors", "localization/movers",
        "localization/grid",
    )  # fmt: skip

    def check_resources(self) -> None:
        """Check that the map in the folder `resume` can be read, and the folder `save` can be written."""
        if self.config.resume is not None:
            try:
                read_manifest(self.config.resume)
            except UserError as error:
                raise UserError(f"resume = {error}") from error
        if self.config.save is not None:
            check_can_write(self.config.save, "save", read_only_disk=True)

    def configure(self) -> None:
        self._slam: LidarSlam | None = None
        self._published_correction: np.ndarray | None = None  # pose_map_odom
        self._optimisations = 0
        self._stamp_ns = 0
        self._grid: GridTiles | None = None
        self._grid_running = False
        self._grid_since_ns: int | None = None  # stamp of the first tile
        self._published_uuid = ""
        self._checkpoint_ns: int | None = None
        self._checkpoint_running = False
        self._fault = self._sensors = ""  # parts of the text of the health message
        live = self.live_settings
        if live is not None:  # else the first scans wait a second for the kernels, and all images with them
            warm()
        self._checkpoint_dir = None if live is None else live.run_dir / "localization"
        self._saver: MapSaver | None = None  # of checkpoints
        self._final_saver: MapSaver | None = None  # of the option `save`
        if self._checkpoint_dir is not None and live is not None and not live.resume:  # of an earlier run
            shutil.rmtree(self._checkpoint_dir, ignore_errors=True)
        if self.config.resume is not None:
            try:
                read_manifest(self.config.resume)
            except UserError as error:
                raise UserError(f"localization.resume: {error}") from error

    def on_rig(self, rig: Rig) -> Outputs:
        """Create the SLAM from the first calibration; ignore later ones, which would distort the map."""
        if rig.lidar is None:
            log.error("the calibration has no lidar: scans cannot be used")
        elif self._slam is None:
            self._stamp_ns = rig.stamp_ns
            self._slam = self._create_slam(rig.lidar.T_body_lidar)
            yield from self._publish_new_map(self._slam)
        else:
            log.warning("a new calibration is ignored: restart the node to use it")

    def _create_slam(self, T_body_lidar: np.ndarray) -> LidarSlam:
        """Return the SLAM from a checkpoint, from the `resume` folder, or with an empty map."""
        # Only after a crash: the checkpoint of an earlier run may be on a disk that is read-only by now.
        crashed = (
            self._checkpoint_dir is not None
            and self.live_settings is not None
            and self.live_settings.resume
            and (self._checkpoint_dir / MANIFEST).is_file()
        )
        folder = self._checkpoint_dir if crashed else self.config.resume
        if folder is None:
            return LidarSlam(LidarSlamSettings(), T_body_lidar)
        try:
            slam = LidarSlam.load(folder, LidarSlamSettings(), T_body_lidar)
        except UserError as error:
            if not crashed:
                raise UserError(f"localization.resume: {error}") from error
            log.error("cannot load the checkpoint, starting a new map: %s", error)
            return LidarSlam(LidarSlamSettings(), T_body_lidar)
        if crashed:
            slam.pose_graph.reserve_submap_ids(_RESERVED_SUBMAP_IDS)
        log.info("continuing the map in %s: %d submaps", folder, len(slam.anchors()))
        return slam

    def on_wheel_odometry(self, odometry: WheelOdometry) -> Outputs:
        if self._slam is not None:
            self._slam.add_odometry(odometry.stamp_ns, *se3_to_se2(odometry.T_odom_body).tolist())
            self.rejections.set("wheel odometry not newer than the last", self._slam.motion.odometry.rejected)
        return iter(())

    def on_lidar_scan(self, scan: Scan) -> Outputs:
        """Publish pose and dynamic beams of a scan; start background jobs; publish the grid at intervals."""
        if self._slam is None:
            yield "localization/odometry", _rejected(scan.stamp_ns, "no calibration yet")
            return
        result = self._slam.add_scan(
            scan.stamp_ns, scan.ranges_m, scan.angle_min_rad, scan.angle_increment_rad,
            scan.time_increment_s, scan.range_min_m, scan.range_max_m,
        )  # fmt: skip
        self._stamp_ns = scan.stamp_ns
        yield from self._publish_new_map(self._slam)
        self._report_sensors(self._slam)
        yield "localization/odometry", _odometry(result)
        yield "localization/movers", MovingBeams(stamp_ns=scan.stamp_ns, moving=result.dynamic)
        yield from self._correction(scan.stamp_ns, result.pose_map_odom)
        if result.job is not None:
            # The result is due before the scan with number `apply_at_scan`; the next scan has number `scans`.
            after = result.job.apply_at_scan - self._slam.scans + 1
            yield Job("optimise", result.job.run, after=after, of="lidar/scan")
        yield from self._start_checkpoint(self._slam, scan.stamp_ns, result.status == "ok")
        yield from self._start_grid(self._slam)

    def on_job_optimise(self, result: JobResult) -> Outputs:
        """Apply the result of a background job and publish the new map poses; T_odom_body does not change."""
        assert self._slam is not None  # it started the job
        self._slam.apply(result)
        self._optimisations += 1
        yield from self._publish_map_poses(self._slam)

    def _start_checkpoint(self, slam: LidarSlam, stamp_ns: int, localized: bool) -> Outputs:
        """Start a job that writes a checkpoint, every `keep_every_s` while the robot is localized."""
        if self._checkpoint_dir is None or self._checkpoint_running or not localized:
            return
        if (
            self._checkpoint_ns is None
            or abs(stamp_ns - self._checkpoint_ns) >= self.config.keep_every_s * 1e9
        ):
            self._checkpoint_ns, self._checkpoint_running = stamp_ns, True
            if self._saver is None:
                self._saver = MapSaver(self._checkpoint_dir, slam.settings)
            saver, saved = self._saver, slam.saved()

            def write() -> str:
                try:
                    saver.save(saved)
                except OSError as error:
                    return f"{saver.folder}: {reason(error)}"
                return ""

            yield Job("checkpoint", write)

    def on_job_checkpoint(self, fault: str) -> Outputs:
        """Show in the health message why the checkpoint was not written (`fault`), if it was not."""
        self._checkpoint_running = False
        self._fault = f"the checkpoint of the map was not written: {fault}" if fault else ""
        self._show()
        return iter(())

    def _report_sensors(self, slam: LidarSlam) -> None:
        """Report what is wrong with wheel odometry and lidar, at intervals."""
        if slam.scans % _REPORT_EVERY_SCANS == 1:
            odometry = slam.motion.odometry.report().text
            texts = [f"wheel odometry: {odometry}" if odometry else "", slam.self_returns.text()]
            self._sensors = "; ".join(text for text in texts if text)
            self._show()

    def _show(self) -> None:
        """Set the text of the health message."""
        self.detail = "; ".join(text for text in (self._fault, self._sensors) if text)

    def drain(self) -> Outputs:
        """Do the final loop closure and optimisation, publish the result and write the requested files.

        If the process must stop, the map is written first, and a final optimisation that takes long is left
        out.
        """
        if self._slam is None or not self._slam.anchors():
            return  # there was no usable scan
        if self.must_stop():
            if self.config.save is not None:
                self._save(self._slam, self.config.save)
            finishing = threading.Thread(target=self._slam.finish, name="finish", daemon=True)
            finishing.start()
            finishing.join(_FINISH_S)
            if finishing.is_alive():
                log.warning("the map is saved without its final optimisation, for which there is no time")
                return
        else:
            self._slam.finish()
        self._optimisations += 1
        yield from self._publish_map_poses(self._slam)
        grid = self._grid or GridTiles(self.config.grid_resolution_m)
        yield from self._publish_grid(grid, grid.update(self._slam.map_content(), exact=True))
        if self.config.save is not None:
            self._save(self._slam, self.config.save)

    def _save(self, slam: LidarSlam, folder: Path) -> None:
        """Write the files of the option `save`.

        Raises:
            UserError: they cannot be written, and nothing else continues (lockstep); live, this is logged and
                shown in the health of the node.
        """
        try:
            if self._final_saver is None:
                self._final_saver = MapSaver(folder, slam.settings)
            self._final_saver.save(slam.saved())
        except OSError as error:
            fault = f"localization.save = {folder}: not written ({reason(error)})"
            if self.live_settings is None:
                raise UserError(fault) from error
            self._fault = self.detail = fault
            log.error("%s", fault)
            return
        log.info("map and state saved to %s", folder)

    def _publish_map_poses(self, slam: LidarSlam) -> Outputs:
        yield from self._correction(self._stamp_ns, slam.pose_graph.pose_map_odom)
        yield from self._anchors(slam)

    def _publish_new_map(self, slam: LidarSlam) -> Outputs:
        """Publish the anchors if the map has a new UUID, before the first pose in this map.

        Subscribers must not mix anchors of two maps.
        """
        if slam.pose_graph.uuid != self._published_uuid:
            yield from self._anchors(slam)

    def _anchors(self, slam: LidarSlam) -> Outputs:
        self._published_uuid = slam.pose_graph.uuid
        anchors = slam.anchors()
        T_map_anchor = se2_to_se3(np.array(list(anchors.values())).reshape(-1, 3))
        yield (
            "localization/anchors",
            Anchors(
                stamp_ns=self._stamp_ns, anchor_ids=np.array(list(anchors), dtype=np.int64),
                T_map_anchor=T_map_anchor, optimisation=self._optimisations,
                map_uuid=slam.pose_graph.uuid,
            ),
        )  # fmt: skip

    def _correction(self, stamp_ns: int, pose_map_odom: np.ndarray) -> Outputs:
        """Publish T_map_odom if it has changed; the topic is latched."""
        if self._published_correction is None or not np.array_equal(
            self._published_correction, pose_map_odom
        ):
            self._published_correction = pose_map_odom.copy()
            yield (
                "localization/correction",
                Correction(
                    stamp_ns=stamp_ns, T_map_odom=se2_to_se3(pose_map_odom), optimisation=self._optimisations
                ),
            )

    def _start_grid(self, slam: LidarSlam) -> Outputs:
        """Start a job that draws the changed tiles of the grid, every `grid_every_scans`."""
        if self._grid_running or slam.scans % self.config.grid_every_scans or not slam.record.count:
            return
        if self._grid is None:
            self._grid = GridTiles(self.config.grid_resolution_m)
        self._grid_running = True
        grid, content = self._grid, slam.map_content()
        after = min(_GRID_AFTER_SCANS, self.config.grid_every_scans)
        yield Job("grid", lambda: grid.update(content), after=after, of="lidar/scan")

    def on_job_grid(self, changed: dict[Place, bytes]) -> Outputs:
        """Publish the changed tiles of the grid."""
        self._grid_running = False
        assert self._grid is not None  # it has drawn them
        yield from self._publish_grid(self._grid, changed)

    def _publish_grid(self, grid: GridTiles, changed: dict[Place, bytes]) -> Outputs:
        assert self._slam is not None
        if self._grid_since_ns is None:
            self._grid_since_ns = self._stamp_ns
        tiles = grid.to_send(changed)
        for sent, ((row, column), packed) in enumerate(tiles.items(), start=1):
            yield (
                "localization/grid",
                GridTile(
                    stamp_ns=self._stamp_ns, resolution_m=grid.resolution_m, size=TILE_CELLS, row=row,
                    column=column, packed=np.frombuffer(packed, dtype=np.uint8), remaining=len(tiles) - sent,
                    map_uuid=self._slam.pose_graph.uuid, since_ns=self._grid_since_ns,
                ),
            )  # fmt: skip


def _odometry(result: ScanResult) -> Odometry:
    status, _, detail = result.status.partition(": ")
    return Odometry(
        stamp_ns=result.stamp_ns, T_odom_body=se2_to_se3(result.pose_odom_body), covariance=result.covariance,
        status=cast(TrackingStatus, status), detail=detail,
        quality=result.quality.value, quality_reason=result.quality.reason,
    )  # fmt: skip


def _rejected(stamp_ns: int, why: str) -> Odometry:
    return Odometry(
        stamp_ns=stamp_ns,
        T_odom_body=np.eye(4),
        covariance=np.full((3, 3), np.nan),
        status="rejected",
        detail=why,
    )
