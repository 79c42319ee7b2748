"""A drive through the room of `room.py` as a source of messages: images, scans, true poses."""

from functools import lru_cache

import numpy as np

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.messages import CameraModel, ExternalPose, Image, LidarModel, Rig, Scan
from beamsplat.common.runtime.node import Node, SourceItem
from tests.services.fusion.room import CAMERA, LIDAR_Z, T_BODY_CAMERA, cast, render

T0 = 1_000_000_000
PERIOD_NS = 100_000_000  # of images and scans, half a period apart
_BEAMS = 360


def pose(stamp_ns):
    """Return T_map_body: 0.8 m/s straight ahead, on a slight curve."""
    t = (stamp_ns - T0) / 1e9
    return se2_to_se3(np.array([0.8 * t, 0.1 * np.sin(t), 0.1 * np.cos(t)]))


@lru_cache(maxsize=64)
def shot(stamp_ns):
    """Return the image and its true optical z (m)."""
    return render(pose(stamp_ns))


def _scan(stamp_ns):
    T_map_body = pose(stamp_ns)
    angles = np.linspace(-np.pi, np.pi, _BEAMS, endpoint=False)
    direction = np.stack([np.cos(angles), np.sin(angles), np.zeros(_BEAMS)], axis=1) @ T_map_body[:3, :3].T
    ranges, _ = cast(T_map_body[:3, 3] + np.array([0.0, 0.0, LIDAR_Z]), direction)
    return Scan(
        stamp_ns=stamp_ns, angle_min_rad=-np.pi, angle_increment_rad=2.0 * np.pi / _BEAMS, time_increment_s=0.0,
        scan_time_s=0.1, range_min_m=0.1, range_max_m=12.0, ranges_m=ranges.astype(np.float32),
    )  # fmt: skip


class RoomSourceConfig(NodeConfig):
    images: int = 20


class RoomSource(Node):
    """Publishes the calibration, then scans with their poses, and images half a period later."""

    name = "replay"
    Config = RoomSourceConfig
    config: RoomSourceConfig
    outputs = ("rig", "external/pose", "lidar/scan", "camera/image")

    def source(self):
        c, T_body_lidar = CAMERA, np.eye(4)
        T_body_lidar[2, 3] = LIDAR_Z
        camera = CameraModel(width_px=c.width_px, height_px=c.height_px, fx_px=c.fx_px, fy_px=c.fy_px, cx_px=c.cx_px,
                             cy_px=c.cy_px, T_body_camera=T_BODY_CAMERA)  # fmt: skip
        yield SourceItem(
            T0, "rig", Rig(stamp_ns=T0, camera=camera, lidar=LidarModel(T_body_lidar=T_body_lidar))
        )
        for k in range(self.config.images + 3):
            stamp_ns = T0 + k * PERIOD_NS
            yield SourceItem(stamp_ns, "lidar/scan", _scan(stamp_ns))
            yield SourceItem(
                stamp_ns, "external/pose", ExternalPose(stamp_ns=stamp_ns, T_map_body=pose(stamp_ns))
            )
            stamp_ns += PERIOD_NS // 2
            if k < self.config.images:
                rgb = shot(stamp_ns)[0]
                image = Image(stamp_ns=stamp_ns, width_px=c.width_px, height_px=c.height_px, encoding="rgb8",
                              data=rgb.reshape(-1))  # fmt: skip
                yield SourceItem(stamp_ns, "camera/image", image)
