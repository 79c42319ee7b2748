"""What a robot's sensors publish: our topic, the word people use for it, and the ROS types that carry it."""

from __future__ import annotations

from typing import Any, NamedTuple

from beamsplat.common import messages as m
from beamsplat.common.recording.from_ros import fields_of


class Sensor(NamedTuple):
    """One kind of sensor data."""

    word: str
    topic: str
    cls: type[m.Message]
    ros_types: tuple[str, ...]  # best first


SENSORS: dict[str, Sensor] = {
    sensor.word: sensor
    for sensor in (
        Sensor(
            "image", "camera/image", m.Image, ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
        ),
        Sensor("scan", "lidar/scan", m.Scan, ("sensor_msgs/msg/LaserScan",)),
        Sensor("odometry", "wheel/odometry", m.WheelOdometry, ("nav_msgs/msg/Odometry",)),
        Sensor(
            "pose", "external/pose", m.ExternalPose,
            ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"),
        ),
    )
}  # fmt: skip

_CLASSES = {sensor.topic: sensor.cls for sensor in SENSORS.values()} | {"tick": m.Tick, "rig": m.Rig}


def build(topic: str, fields: dict[str, Any]) -> m.Message:
    """The message of one of the topics above, "rig" or "tick".

    Raises:
        ValueError: a field that the message refuses; says which and why.
    """
    return _CLASSES[topic].model_validate(fields)


def ros_fields(topic: str, ros_message: Any) -> dict[str, Any]:
    """What a ROS message of one of these sensors holds, as the fields of our message, unchecked."""
    return fields_of(_CLASSES[topic], ros_message)
