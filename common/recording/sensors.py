"""Kinds of sensor data of a robot: their names in options, topics, message classes and ROS message types."""

from __future__ import annotations

from typing import Any, NamedTuple

from beamsplat.common import messages as m
from beamsplat.common.recording.from_ros import fields_of


class SensorType(NamedTuple):
    """One kind of sensor data: its name, BeamSplat topic, message class and ROS message types."""

    name: str  # in options and texts, for example "image" in `image_topic`
    topic: str
    cls: type[m.Message]
    ros_types: tuple[str, ...]  # in order of preference


SENSORS: dict[str, SensorType] = {
    sensor.name: sensor
    for sensor in (
        SensorType(
            "image", "camera/image", m.Image, ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
        ),
        SensorType(
            "scan", "lidar/scan", m.Scan,
            ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan"),
        ),
        SensorType("odometry", "wheel/odometry", m.WheelOdometry, ("nav_msgs/msg/Odometry",)),
        SensorType(
            "pose", "external/pose", m.ExternalPose,
            ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"),
        ),
    )
}  # fmt: skip

_CLASSES = {sensor.topic: sensor.cls for sensor in SENSORS.values()} | {"tick": m.Tick, "rig": m.Rig}


def build_message(topic: str, fields: dict[str, Any]) -> m.Message:
    """Create and validate a message from its fields; `topic` is a sensor topic, "rig" or "tick".

    Raises:
        ValueError: a field is invalid; the text names the field and the reason.
    """
    return _CLASSES[topic].model_validate(fields)


def ros_fields(topic: str, ros_message: Any) -> dict[str, Any]:
    """Return the fields that a ROS message contains for the BeamSplat message on `topic`, not validated."""
    return fields_of(_CLASSES[topic], ros_message)
