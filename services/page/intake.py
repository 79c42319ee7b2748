"""Messages of one robot -> the state that the page shows of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.mapfiles.grid_tiles import GridSource, TiledGrid
from beamsplat.common.messages import (
    Correction,
    ExternalPose,
    FusedDepth,
    GridTile,
    Health,
    Image,
    MapPreview,
    MapStatus,
    Message,
    Odometry,
    Rig,
    Scan,
    WheelOdometry,
)
from beamsplat.services.page.images import EncodedImage, encode_camera_image, encode_depth, encode_tiles
from beamsplat.services.page.map3d.source import MountedCamera, ShownCamera
from beamsplat.services.page.view import PageState


class RobotIntake:
    """Writes the messages of one robot into its `PageState`. Not thread-safe."""

    def __init__(self, state: PageState, widest_px: int, reject: Callable[[str], None]) -> None:
        """Create the intake of a robot.

        Args:
            state: of this robot.
            widest_px: wider images are scaled down.
            reject: called with the reason for each grid tile that is damaged.
        """
        self.state = state
        self._widest_px, self._reject = widest_px, reject
        self._grid = TiledGrid()
        self._take: dict[str, Callable[[Any], None]] = {
            "rig": self._rig, "wheel/odometry": self._wheel_odometry, "lidar/scan": self._scan,
            "camera/image": self._image, "external/pose": self._external_pose,
            "localization/odometry": self._odometry, "localization/correction": self._correction,
            "localization/grid": self._tile, "fusion/depth": self._depth, "mapping/preview": self._preview,
            "mapping/status": self._status,
        }  # fmt: skip

    def take(self, topic: str, message: Message) -> None:
        """Store one message of a topic that the page shows."""
        self.state.heard_s = time.monotonic()
        self._take[topic](message)

    def take_health(self, health: Health) -> None:
        """Store a health report of a node of this robot."""
        self.state.heard_s = time.monotonic()
        self.state.health(health)

    def _rig(self, m: Rig) -> None:
        if m.camera is not None:
            shown = ShownCamera(m.camera.width_px, m.camera.height_px, Pinhole.of(m.camera).K)
            self.state.camera = MountedCamera(shown, m.camera.T_body_camera)
        if m.lidar is not None:
            self.state.lidar(m.lidar.T_body_lidar)

    def _wheel_odometry(self, m: WheelOdometry) -> None:
        self.state.pose("wheel", m.stamp_ns, m.T_odom_body)

    def _scan(self, m: Scan) -> None:
        self.state.scan(
            m.stamp_ns, m.ranges_m, m.angle_min_rad, m.angle_increment_rad, (m.range_min_m, m.range_max_m)
        )

    def _image(self, m: Image) -> None:
        size_px = (m.width_px, m.height_px)
        self.state.images["camera"].update(
            partial(encode_camera_image, m.data, m.encoding, size_px, m.step_bytes, self._widest_px)
        )

    def _external_pose(self, m: ExternalPose) -> None:
        self.state.pose("external", m.stamp_ns, m.T_map_body)

    def _odometry(self, m: Odometry) -> None:
        self.state.pose("localization", m.stamp_ns, m.T_odom_body)
        self.state.service_status("localization", m.status, detail=m.detail, metric=m.metric)

    def _correction(self, m: Correction) -> None:
        self.state.correction(m.T_map_odom)

    def _tile(self, m: GridTile) -> None:
        """Store a tile of the grid; with the last tile of an update, offer the whole grid to the pages."""
        source = GridSource(m.map_uuid, m.since_ns, m.resolution_m, m.size)
        try:
            self._grid.add(source, m.row, m.column, m.packed.tobytes())
        except ValueError as error:
            self._reject(str(error))
        if m.remaining == 0:
            self.state.images["map"].update(partial(encode_tiles, self._grid.copy()))

    def _depth(self, m: FusedDepth) -> None:
        self.state.service_status(
            "fusion", "ok" if m.status == "ok" else "refused", detail=m.status.removeprefix("ok"),
            scale=m.scale, scale_sigma=m.scale_sigma, inlier_share=m.inlier_share, residual_m=m.residual_m,
        )  # fmt: skip
        self.state.scale(m.scale, m.scale_sigma)
        if m.depth.size:  # decoded only while a page is open
            self.state.images["depth"].update(lambda: encode_depth(m.depth_m, self._widest_px))

    def _preview(self, m: MapPreview) -> None:
        self.state.images["render"].update(lambda: EncodedImage(m.render.tobytes(), "image/jpeg", {}))

    def _status(self, m: MapStatus) -> None:
        self.state.service_status(
            "mapping", "ok" if m.status == "ok" else "refused", detail=m.status.removeprefix("ok"),
            keyframes=m.keyframes, gaussians=m.gaussians, psnr_db=m.psnr_db, depth_error_m=m.depth_error_m,
        )  # fmt: skip
