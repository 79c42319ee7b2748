"""Gives back to ROS 2, over rmw_zenoh's keys and without ROS: pose, transforms, map and cloud."""

from __future__ import annotations

import time
from typing import Any

import zenoh
import zenoh.ext

from beamsplat.common.messages import Cloud, Correction, Grid, Odometry, WheelOdometry
from beamsplat.common.recording import ros_types as ros
from beamsplat.common.runtime.node import Node, Outputs
from beamsplat.common.zenoh.bus import open_session
from beamsplat.common.zenoh.rmw import Attachment, Entity, Qos, data_key
from beamsplat.services.ros2_out import conversions as answers
from beamsplat.services.ros2_out.config import Ros2OutConfig

_VOLATILE = Qos(depth=10)
_LATCHED = Qos(transient_local=True, depth=1)


class RosPublisher:
    """One topic, as rmw_zenoh_cpp would publish it."""

    def __init__(
        self, session: zenoh.Session, domain: int, number: int, topic: str, type_name: str, qos: Qos
    ) -> None:
        type_hash = ros.typestore().hash_rihs01(type_name)
        entity = Entity(
            domain, str(session.zid()), 0, number, "MP", "beamsplat", topic="/" + topic.strip("/"),
            type_name=type_name, type_hash=type_hash, qos=qos,
        )  # fmt: skip
        key = data_key(domain, topic, type_name, type_hash)
        if qos.transient_local:
            self._publisher = zenoh.ext.declare_advanced_publisher(
                session, key,
                congestion_control=zenoh.CongestionControl.DROP,
                cache=zenoh.ext.CacheConfig(qos.depth),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(sporadic_heartbeat=0.5),
                publisher_detection=True,
            )  # fmt: skip
        else:
            self._publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        self._token = session.liveliness().declare_token(entity.token())
        self._gid = entity.gid()
        self.sent = 0

    def put(self, message: Any) -> None:
        """Sends one ROS message."""
        self.sent += 1
        attachment = Attachment(self.sent, time.time_ns(), self._gid)
        self._publisher.put(ros.serialize(message), attachment=attachment.pack())


class Ros2OutNode(Node):
    """What this system finds, for a robot's ROS 2 nodes."""

    name = "ros2_out"
    Config = Ros2OutConfig
    config: Ros2OutConfig
    inputs = (
        "wheel/odometry",
        "localization/odometry",
        "localization/correction",
        "localization/grid",
        "fusion/cloud",
    )

    def configure(self) -> None:
        c = self.config
        self._transforms = answers.Transforms(c.map_frame, c.odom_frame, c.body_frame)
        self._session = open_session((c.router,))
        node = Entity(c.domain, str(self._session.zid()), 0, 0, "NN", "beamsplat")
        self._token = self._session.liveliness().declare_token(node.token())
        wanted = (
            ("pose", c.pose_topic, answers.POSE, _VOLATILE),
            ("tf", "/tf" if c.tf else "", answers.TF, Qos(depth=100)),
            ("map", c.map_topic, answers.MAP, _LATCHED),
            ("cloud", c.cloud_topic, answers.CLOUD, _VOLATILE),
        )
        self._publishers = {
            word: RosPublisher(self._session, c.domain, number, topic, type_name, qos)
            for number, (word, topic, type_name, qos) in enumerate(wanted, start=1)
            if topic
        }

    def on_wheel_odometry(self, odometry: WheelOdometry) -> Outputs:
        self._transforms.add_wheels(odometry.stamp_ns, odometry.T_odom_body)
        return iter(())

    def on_localization_correction(self, correction: Correction) -> Outputs:
        self._transforms.T_map_odom = correction.T_map_odom
        return iter(())

    def on_localization_odometry(self, odometry: Odometry) -> Outputs:
        """Pose and transforms; nothing while the localization does not know."""
        if odometry.status == "ok":
            self._put("pose", self._transforms.pose(odometry.stamp_ns, odometry.T_odom_body))
            self._put("tf", self._transforms.tf(odometry.stamp_ns, odometry.T_odom_body))
        return iter(())

    def on_localization_grid(self, grid: Grid) -> Outputs:
        self._put(
            "map",
            answers.occupancy_grid(
                grid.stamp_ns, self.config.map_frame, grid.resolution_m, grid.origin_m, grid.occupancy
            ),
        )
        return iter(())

    def on_fusion_cloud(self, cloud: Cloud) -> Outputs:
        self._put(
            "cloud",
            answers.point_cloud(
                cloud.stamp_ns, self.config.map_frame, cloud.points_odom_m, cloud.colours,
                self._transforms.T_map_odom,
            ),
        )  # fmt: skip
        return iter(())

    def close(self) -> None:
        if hasattr(self, "_session"):
            self._session.close()

    def _put(self, word: str, message: Any | None) -> None:
        if message is not None and word in self._publishers:
            self._publishers[word].put(message)
            sent = ", ".join(f"{name} {p.sent}" for name, p in self._publishers.items())
            self.detail = f"to ROS 2: {sent}"
