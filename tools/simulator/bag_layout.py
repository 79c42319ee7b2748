"""Topics, frames and encodings of a recorded bag: the names and forms that a robot's drivers use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from beamsplat.common.geometry.transforms import inverse, make_transform
from beamsplat.tools.simulator.lidar_drivers import SectorFilter


@dataclass(frozen=True)
class FrameLink:
    """A frame between the base and the sensors, with the orientation of its parent."""

    parent: str
    child: str
    xyz_m: tuple[float, float, float]
    joint: bool = False  # a joint at rest: on /tf again and again (robot_state_publisher), not on /tf_static


@dataclass(frozen=True)
class BagLayout:
    """What the drivers of a robot call and encode their messages; the defaults are those of our own robot."""

    scan_topic: str = "/scan"
    raw_scan_topic: str = ""  # of the driver, if `scan_topic` is that of the node `scan_filter`
    scan_filter: SectorFilter | None = None
    odometry_topic: str = "/odom"
    raw_odometry_topic: str = ""  # the wheel odometry once more, before a filter
    image_topic: str = "/camera/image_raw/compressed"
    camera_info_topic: str = "/camera/camera_info"
    image_encoding: Literal["jpeg", "rgb8"] = "jpeg"  # jpeg: CompressedImage, rgb8: Image
    jpeg_format: str = "jpeg"  # field `format` of CompressedImage
    distortion_model: str = "plumb_bob"  # or rational_polynomial, with k4 to k6 of 0
    image_delay_s: float = 0.028  # from the stamp to the reception, without the random part
    base_frame: str = "base_link"  # on the floor between the wheels
    odometry_frame: str = "odom"
    lidar_frame: str = "laser"
    camera_frame: str = "camera_optical_frame"
    links: tuple[FrameLink, ...] = ()
    lidar_parent: str = ""  # a frame of `links`; "" = the base
    camera_parent: str = ""
    joint_rate_hz: float = 10.0  # of the joints on /tf
    reliable: bool = False  # whether the sensors' publishers offer reliable delivery

    def topics(self, *, camera: bool) -> dict[str, str]:
        """Return the ROS type of each topic of the bag."""
        scan, odometry = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
        found = {
            "/tf_static": "tf2_msgs/msg/TFMessage",
            "/tf": "tf2_msgs/msg/TFMessage",
            self.odometry_topic: odometry,
            self.scan_topic: scan,
            self.raw_odometry_topic: odometry,
            self.raw_scan_topic: scan,
        }
        if camera:
            image = "CompressedImage" if self.image_encoding == "jpeg" else "Image"
            found[self.image_topic] = f"sensor_msgs/msg/{image}"
            found[self.camera_info_topic] = "sensor_msgs/msg/CameraInfo"
        return {name: kind for name, kind in found.items() if name}

    def sensor_topics(self) -> set[str]:
        """Return the topics that a driver with sensor QoS publishes best effort."""
        return {self.scan_topic, self.raw_scan_topic, self.image_topic, self.camera_info_topic}

    def edges(
        self, T_base_lidar: np.ndarray, T_base_camera: np.ndarray | None, *, joints: bool
    ) -> list[tuple[str, str, np.ndarray]]:
        """Return (parent, child, T_parent_child [4, 4]) of /tf (joints) or of /tf_static.

        The mounts [4, 4] of the sensors on the base are split along their chains of frames.
        """
        found = [(k.parent, k.child, _offset(k)) for k in self.links if k.joint == joints]
        if not joints:
            sensors = [(self.lidar_parent, self.lidar_frame, T_base_lidar)]
            if T_base_camera is not None:
                sensors.insert(0, (self.camera_parent, self.camera_frame, T_base_camera))
            for parent, child, T in sensors:
                found.append((parent or self.base_frame, child, inverse(self._pose(parent)) @ T))
        return found

    def _pose(self, frame: str) -> np.ndarray:
        """Return T_base_frame [4, 4] of the base or of a frame of `links`."""
        by_child = {k.child: k for k in self.links}
        T = np.eye(4)
        while frame in by_child:
            T = _offset(by_child[frame]) @ T
            frame = by_child[frame].parent
        return T


def _offset(link: FrameLink) -> np.ndarray:
    return make_transform(np.eye(3), np.array(link.xyz_m))
