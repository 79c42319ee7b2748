"""Selection of a robot's topics, by the same rules as for bags (common/recording/topic_choice.py)."""

from __future__ import annotations

from beamsplat.common.recording.camera_info import CAMERA_INFO
from beamsplat.common.recording.sensors import SENSORS
from beamsplat.common.recording.topic_choice import (
    Candidate,
    choose_camera_info,
    choose_topic,
    left_out_by_name,
)

IMAGE = "sensor_msgs/msg/Image"
TF = "tf2_msgs/msg/TFMessage"
SUPPORTED_TYPES = frozenset({t for sensor in SENSORS.values() for t in sensor.ros_types} | {CAMERA_INFO, TF})


def kind_of(type_name: str) -> str:
    """Return the sensor kind ("image", "scan", ...) of a ROS type; "" for CameraInfo and transforms."""
    return next((kind for kind, sensor in SENSORS.items() if type_name in sensor.ros_types), "")


def select_topics(
    seen: dict[str, str],  # type by topic, also of CameraInfo
    wanted: dict[str, str],  # topic by kind, set by options
    without: frozenset[str],
) -> tuple[dict[str, str], list[str]]:
    """Return the topic of each sensor kind ("image", "scan", "odometry", "pose") that has one, and why.

    `without`: sensor kinds that are not used. A topic set by an option may not have sent anything yet.

    Raises:
        UserError: several topics match, or a topic set by option has another type.
    """
    topics = [Candidate(topic, type_name) for topic, type_name in seen.items()]
    chosen: dict[str, str] = {}
    notes = []
    for kind in ("scan", "image", "odometry", "pose"):
        named = "/" + wanted[kind].strip("/") if wanted.get(kind) else ""
        if kind in without or (named and named not in seen):
            continue
        choice = choose_topic(kind, topics, "ros2", named, chosen.get("scan", ""))
        if choice is not None:
            chosen[kind] = choice.topic.name
            if choice.reason and not named:
                notes.append(f"{choice.topic.name} is {choice.reason}")
        elif kind == "image":
            notes += [f"{name} is not used: {why}" for name, why in left_out_by_name(topics, kind).items()]
    return chosen, notes


def select_camera_info(image: str, infos: list[str], named: str) -> str | None:
    """Return the CameraInfo topic that belongs to the topic `image`; None if there is none yet.

    `infos`: all CameraInfo topics; `named`: the topic set by option, or "".

    Raises:
        UserError: several topics match.
    """
    if named and named.strip("/") not in (topic.strip("/") for topic in infos):
        return None
    return choose_camera_info([Candidate(topic, CAMERA_INFO) for topic in infos], image, "ros2", named)
