"""Which of a robot's topics is the camera, the lidar, the odometry: the same rule as for bags."""

from __future__ import annotations

from beamsplat.common.errors import UserError
from beamsplat.common.recording.sensors import SENSORS

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMAGE = "sensor_msgs/msg/Image"
TF = "tf2_msgs/msg/TFMessage"
WANTED = frozenset({t for sensor in SENSORS.values() for t in sensor.ros_types} | {CAMERA_INFO, TF})
PICTURES = ("rgb8", "bgr8", "rgba8", "bgra8", "mono8", "yuv422_yuy2", "jpeg", "png")
# A pose somebody wants is not a pose the robot has; depth is not a picture.
_UNFIT = {
    "pose": ("goal", "target", "waypoint", "initial", "plan", "setpoint", "click"),
    "image": ("depth", "disparity", "mask", "semantic"),
}


def choose(
    seen: dict[str, str],  # type by topic
    wanted: dict[str, str],  # topic by word, where an option names it
    without: frozenset[str],
) -> dict[str, str]:
    """Topic by word ("image", "scan", "odometry", "pose") of those seen.

    Raises:
        UserError: several would do, or a named one is of another type.
    """
    chosen = {}
    for word, sensor in SENSORS.items():
        if word in without:
            continue
        named = wanted.get(word, "")
        fitting = [topic for topic, kind in seen.items() if kind in sensor.ros_types]
        if named:
            named = "/" + named.strip("/")
            if named in seen and named not in fitting:
                raise UserError(
                    f"ros2: {word}_topic = {named!r} is a {seen[named]}; topics that would do: "
                    f"{', '.join(sorted(fitting)) or 'none'}"
                )
            if named in seen:
                chosen[word] = named
            continue
        fitting = [topic for topic in fitting if not any(x in topic.lower() for x in _UNFIT.get(word, ()))]
        if word == "image":  # the same picture raw and compressed counts once, compressed
            fitting = [topic for topic in fitting if f"{topic}/compressed" not in fitting]
        elif fitting:
            best = min(sensor.ros_types.index(seen[topic]) for topic in fitting)
            fitting = [topic for topic in fitting if sensor.ros_types.index(seen[topic]) == best]
        if len(fitting) > 1:
            raise UserError(
                f"ros2: the robot has several topics for {word}: {', '.join(sorted(fitting))}; choose one "
                f'with {word}_topic = "{sorted(fitting)[0]}", or none with without = ["{word}"]'
            )
        if fitting:
            chosen[word] = fitting[0]
    return chosen


def camera_info_of(image: str, infos: list[str], named: str) -> str | None:
    """The CameraInfo topic that belongs to an image topic; None if there is none yet.

    Raises:
        UserError: several would do.
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
            f"ros2: none of the CameraInfo topics lies beside {image}: {', '.join(sorted(infos))}; choose "
            "one with camera_info_topic"
        )
    return infos[0] if infos else None
