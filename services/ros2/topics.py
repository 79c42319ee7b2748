"""Selection of a robot's camera, lidar and odometry topics, by the same rule as for bags."""

from __future__ import annotations

from beamsplat.common.errors import UserError
from beamsplat.common.recording.sensors import SENSORS

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMAGE = "sensor_msgs/msg/Image"
TF = "tf2_msgs/msg/TFMessage"
SUPPORTED_TYPES = frozenset({t for sensor in SENSORS.values() for t in sensor.ros_types} | {CAMERA_INFO, TF})
# Topic names of goals (not the robot's pose), and of depth and masks (no camera image).
_EXCLUDED_NAMES = {
    "pose": ("goal", "target", "waypoint", "initial", "plan", "setpoint", "click"),
    "image": ("depth", "disparity", "mask", "semantic"),
}


def select_topics(
    seen: dict[str, str],  # type by topic
    wanted: dict[str, str],  # topic by kind, set by options
    without: frozenset[str],
) -> dict[str, str]:
    """Return the topic of each sensor kind ("image", "scan", "odometry", "pose") that has one.

    `without`: sensor kinds that are not used.

    Raises:
        UserError: several topics match, or a topic set by option has another type.
    """
    chosen = {}
    for kind, sensor in SENSORS.items():
        if kind in without:
            continue
        named = wanted.get(kind, "")
        fitting = [topic for topic, type_name in seen.items() if type_name in sensor.ros_types]
        if named:
            named = "/" + named.strip("/")
            if named in seen and named not in fitting:
                raise UserError(
                    f"ros2: {kind}_topic = {named!r} has type {seen[named]}; matching topics: "
                    f"{', '.join(sorted(fitting)) or 'none'}"
                )
            if named in seen:
                chosen[kind] = named
            continue
        fitting = [
            topic for topic in fitting if not any(x in topic.lower() for x in _EXCLUDED_NAMES.get(kind, ()))
        ]
        if kind == "image":  # of the same image raw and compressed, take compressed
            fitting = [topic for topic in fitting if f"{topic}/compressed" not in fitting]
        elif fitting:
            best = min(sensor.ros_types.index(seen[topic]) for topic in fitting)
            fitting = [topic for topic in fitting if sensor.ros_types.index(seen[topic]) == best]
        if len(fitting) > 1:
            raise UserError(
                f"ros2: the robot has several topics for {kind}: {', '.join(sorted(fitting))}; set one "
                f'with {kind}_topic = "{sorted(fitting)[0]}", or none with without = ["{kind}"]'
            )
        if fitting:
            chosen[kind] = fitting[0]
    return chosen


def select_camera_info(image: str, infos: list[str], named: str) -> str | None:
    """Return the CameraInfo topic that belongs to the topic `image`; None if there is none yet.

    `infos`: all CameraInfo topics; `named`: the topic set by option, or "".

    Raises:
        UserError: several topics match.
    """
    if named:
        named = "/" + named.strip("/")
        return named if named in infos else None
    parts = image.split("/")
    above = {"/".join(parts[:i]) for i in range(2, len(parts))}
    beside = [topic for topic in infos if topic.rsplit("/", 1)[0] in above]
    if beside:
        return max(beside, key=lambda topic: len(topic.rsplit("/", 1)[0]))
    if len(infos) > 1:
        raise UserError(
            f"ros2: no CameraInfo topic has the namespace of {image}: {', '.join(sorted(infos))}; set "
            "one with camera_info_topic"
        )
    return infos[0] if infos else None
