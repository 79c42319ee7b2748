"""A small system for tests of the page: camera, lidar, a robot that drives a circle in a room, map and
depth.
"""

import time

import cv2
import numpy as np

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.messages import Correction, FusedDepth, Image, Odometry, Rig, Scan
from beamsplat.common.messages.sensor_models import LidarModel
from beamsplat.common.runtime.node import Node, SourceItem
from beamsplat.common.runtime.registry import Service
from tests.common.tiles import tiles

NASTY = "<img src=x onerror=\"document.title='taken over'\"> & <b>bold</b>"
SCALE, SCALE_SIGMA = 1.25, 0.05
RADIUS_M = 1.0
WALL_M = 2.0  # distance of the room's walls from its centre


class RoomSensors(Node):
    """Publishes images at 10 Hz with changing grey, and scans of a square room, in real time."""

    name = "replay"
    outputs = ("rig", "camera/image", "lidar/scan")

    def source(self):
        yield SourceItem(None, "rig", Rig(stamp_ns=1, lidar=LidarModel(T_body_lidar=np.eye(4)), source=NASTY))
        started = time.monotonic()
        for i in range(100_000):
            while time.monotonic() < started + 0.1 * i:
                yield None
                time.sleep(0.01)
            stamp_ns = time.time_ns()
            bgr = np.full((240, 320, 3), 50 + i % 150, np.uint8)
            jpeg = cv2.imencode(".jpg", bgr)[1].ravel()
            yield SourceItem(
                None, "camera/image",
                Image(stamp_ns=stamp_ns, width_px=320, height_px=240, encoding="jpeg", data=jpeg),
            )  # fmt: skip
            angle = np.linspace(-np.pi, np.pi, 360, endpoint=False)
            ranges = WALL_M / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
            yield SourceItem(
                None, "lidar/scan",
                Scan(stamp_ns=stamp_ns, angle_min_rad=-np.pi, angle_increment_rad=2 * np.pi / 360,
                     time_increment_s=0.0, scan_time_s=0.1, range_min_m=0.1, range_max_m=12.0,
                     ranges_m=ranges.astype(np.float32)),
            )  # fmt: skip


class CirclingLocalization(Node):
    """Publishes poses on a circle, and the map of the room."""

    name = "localization"
    inputs = ("lidar/scan",)
    outputs = ("localization/odometry", "localization/correction", "localization/grid")

    def configure(self):
        self._count = 0
        self.detail = NASTY

    def on_lidar_scan(self, scan):
        if self._count == 0:
            T_map_odom = se2_to_se3(np.array([0.5, 0.0, 0.0]))
            yield "localization/correction", Correction(stamp_ns=scan.stamp_ns, T_map_odom=T_map_odom)
            occupancy = np.zeros((60, 60), np.int8)
            occupancy[[0, -1], :] = occupancy[:, [0, -1]] = 100
            for part in tiles(scan.stamp_ns, occupancy, (-30, -30), 32):
                yield "localization/grid", part
        turn = 0.05 * self._count
        self._count += 1
        at = np.array([RADIUS_M * np.cos(turn), RADIUS_M * np.sin(turn), turn + np.pi / 2])
        yield (
            "localization/odometry",
            Odometry(stamp_ns=scan.stamp_ns, T_odom_body=se2_to_se3(at), covariance=np.eye(3)),
        )


class FloorDepthConfig(NodeConfig):
    scale: Remote[float] = SCALE


class FloorDepth(Node):
    """Publishes depth of a floor with its scale."""

    name = "fusion"
    Config = FloorDepthConfig
    replaceable = True
    inputs = ("camera/image",)
    outputs = ("fusion/depth",)

    def on_camera_image(self, picture):
        depth = np.linspace(0.5, 6.0, 60 * 80, dtype=np.float32).reshape(60, 80)
        depth[:5] = np.nan
        fused = FusedDepth.of(stamp_ns=picture.stamp_ns, depth_m=depth, sigma_m=0.1 * depth, scale=self.config.scale,
                           scale_sigma=SCALE_SIGMA, inlier_share=0.9, residual_m=0.02)  # fmt: skip
        yield "fusion/depth", fused


_HERE = "tests.services.monitor.demo_system:"
TABLE = {
    "replay": Service("replay", "", {"default": _HERE + "RoomSensors"}),
    "localization": Service("localization", "", {"default": _HERE + "CirclingLocalization"}),
    "fusion": Service("fusion", "", {"default": _HERE + "FloorDepth"}),
}
