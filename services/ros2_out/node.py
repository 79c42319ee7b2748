"""The ros2_out node: publishes pose, transforms, map and point cloud to ROS 2, without a ROS installation.

It uses the Zenoh keys of rmw_zenoh.
"""

from __future__ import annotations

import time
from typing import Any

import zenoh
import zenoh.ext

from beamsplat.common.mapfiles.grid_tiles import GridSource
from beamsplat.common.messages import Cloud, Correction, GridTile, Odometry, WheelOdometry
from beamsplat.common.recording import ros_types as ros
from beamsplat.common.runtime.node import Node, Outputs
from beamsplat.common.zenoh.bus import open_session
from beamsplat.common.zenoh.rmw import RmwAttachment, RmwEntity, RmwQos, data_key
from beamsplat.services.ros2_out import conversions
from beamsplat.services.ros2_out.config import Ros2OutConfig
from beamsplat.services.ros2_out.grid_publisher import GridPublisher

_VOLATILE = RmwQos(depth=10)
_LATCHED = RmwQos(transient_local=True, depth=1)


class RosPublisher:
    """A publisher of one ROS topic, declared in the same way as by rmw_zenoh_cpp."""

    def __init__(
        self, session: zenoh.Session, domain: int, number: int, topic: str, type_name: str, qos: RmwQos
    ) -> None:
        type_hash = ros.typestore().hash_rihs01(type_name)
        entity = RmwEntity(
            domain, str(session.zid()), 0, number, "MP", "beamsplat", topic="/" + topic.strip("/"),
            type_name=type_name, type_hash=type_hash, qos=qos,
        )  # fmt: skip
        key = data_key(domain, topic, type_name, type_hash)
        self._publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher
        if qos.transient_local:
            self._publisher = zenoh.ext.declare_advanced_publisher(
                session, key,
                congestion_control=zenoh.CongestionControl.DROP,
                cache=zenoh.ext.CacheConfig(qos.depth),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
                publisher_detection=True,
            )  # fmt: skip
        else:
            self._publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        self._token = session.liveliness().declare_token(entity.token())
        self._gid = entity.gid()
        self.sent = 0

    def put(self, message: Any) -> None:
        """Publish one ROS message."""
        self.sent += 1
        attachment = RmwAttachment(self.sent, time.time_ns(), self._gid)
        self._publisher.put(ros.serialize(message), attachment=attachment.pack())


class Ros2OutNode(Node):
    """Publishes the results of BeamSplat to a robot's ROS 2 nodes."""

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
        self._transforms = conversions.TfTree(c.map_frame, c.odom_frame, c.body_frame)
        self._grid = GridPublisher(c.map_frame, c.map_every_s)
        self._session = open_session((c.router,))
        node = RmwEntity(c.domain, str(self._session.zid()), 0, 0, "NN", "beamsplat")
        self._token = self._session.liveliness().declare_token(node.token())
        wanted = (
            ("pose", c.pose_topic, conversions.POSE, _VOLATILE),
            ("pose_covariance", c.pose_covariance_topic, conversions.POSE_COVARIANCE, _VOLATILE),
            ("tf", "/tf" if c.tf else "", conversions.TF, RmwQos(depth=100)),
            ("map", c.map_topic, conversions.MAP, _LATCHED),
            ("map_updates", c.map_topic and f"{c.map_topic}_updates", ros.GRID_UPDATE, RmwQos(depth=100)),
            ("cloud", c.cloud_topic, conversions.CLOUD, _VOLATILE),
        )
        self._publishers = {
            name: RosPublisher(self._session, c.domain, number, topic, type_name, qos)
            for number, (name, topic, type_name, qos) in enumerate(wanted, start=1)
            if topic
        }

    def on_wheel_odometry(self, odometry: WheelOdometry) -> Outputs:
        self._transforms.add_wheel_odometry(odometry.stamp_ns, odometry.T_odom_body)
        return iter(())

    def on_localization_correction(self, correction: Correction) -> Outputs:
        self._transforms.T_map_odom = correction.T_map_odom
        return iter(())

    def on_localization_odometry(self, odometry: Odometry) -> Outputs:
        """Publish pose and transforms, if the status of localization is ok."""
        if odometry.status == "ok":
            self._publish("pose", self._transforms.pose(odometry.stamp_ns, odometry.T_odom_body))
            self._publish(
                "pose_covariance",
                self._transforms.pose_with_covariance(
                    odometry.stamp_ns, odometry.T_odom_body, odometry.covariance
                ),
            )
            self._publish("tf", self._transforms.tf(odometry.stamp_ns, odometry.T_odom_body))
        return iter(())

    def on_localization_grid(self, tile: GridTile) -> Outputs:
        """Store a tile; after the last one of an update, publish the whole map or what has changed in it."""
        source = GridSource(tile.map_uuid, tile.since_ns, tile.resolution_m, tile.size)
        try:
            self._grid.add(source, tile.row, tile.column, tile.packed.tobytes())
            for name, message in self._grid.messages(tile.stamp_ns) if tile.remaining == 0 else ():
                self._publish(name, message)
        except ValueError as error:
            self.rejections.add(f"map not published: {error}")
        return iter(())

    def on_fusion_cloud(self, cloud: Cloud) -> Outputs:
        self._publish(
            "cloud",
            conversions.point_cloud(
                cloud.stamp_ns, self.config.map_frame, cloud.points_odom_m, cloud.colours,
                self._transforms.T_map_odom,
            ),
        )  # fmt: skip
        return iter(())

    def close(self) -> None:
        if hasattr(self, "_session"):
            self._session.close()

    def _publish(self, name: str, message: Any | None) -> None:
        if message is not None and name in self._publishers:
            self._publishers[name].put(message)
            sent = ", ".join(f"{name} {p.sent}" for name, p in self._publishers.items())
            self.detail = f"to ROS 2: {sent}"
