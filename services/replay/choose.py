"""Which topic is the camera, the lidar, the odometry: by type, by option where several would do."""

from __future__ import annotations

from collections.abc import Callable

from beamsplat.common.errors import UserError
from beamsplat.common.recording.sensors import SENSORS, Sensor
from beamsplat.services.replay.bags import BagTopic
from beamsplat.services.replay.options import SourceOptions

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
# A pose somebody wants is not a pose the robot has; depth is not a picture.
_NOT_POSES = ("goal", "target", "waypoint", "initial", "plan", "setpoint", "click")
_NOT_IMAGES = ("depth", "disparity", "mask", "semantic")


def choose_topics(
    topics: list[BagTopic], options: SourceOptions, where: str, is_picture: Callable[[BagTopic], bool]
) -> dict[str, BagTopic]:
    """Topic by word ("image", "scan", ...); words without one are left out.

    `is_picture` tells whether a raw image topic holds pictures we can use (it reads the first one).

    Raises:
        UserError: several topics would do, a chosen one is not there or of another type, or one that is
            required is missing.
    """
    chosen: dict[str, BagTopic] = {}
    for word, sensor in SENSORS.items():
        if word in options.without:
            continue
        name = options.topic_for(word)
        topic = _named(topics, sensor, name, where) if name else _by_type(topics, sensor, where, is_picture)
        if topic is not None:
            chosen[word] = topic
    for word in sorted(options.require - options.without):
        if word not in chosen:
            types = " or ".join(SENSORS[word].ros_types)
            there = ", ".join(f"{t.name} ({t.type_name})" for t in topics if t.count) or "nothing"
            raise UserError(
                f"{where}: has no {word}: no topic of type {types}; it holds {there}. Use another recording, "
                f'or set without = ["{word}"] if the deployment does not need one'
            )
    return chosen


def _named(topics: list[BagTopic], sensor: Sensor, name: str, where: str) -> BagTopic:
    found = [topic for topic in topics if topic.name == name or topic.name == "/" + name]
    fitting = [topic for topic in found if topic.type_name in sensor.ros_types and topic.count]
    if fitting:
        return fitting[0]
    others = ", ".join(t.name for t in topics if t.type_name in sensor.ros_types and t.count) or "none"
    if found:
        problem = f"is a {found[0].type_name}" if found[0].count else "has no messages"
        raise UserError(f"{where}: {sensor.word}_topic = {name!r} {problem}; topics that would do: {others}")
    raise UserError(f"{where}: {sensor.word}_topic = {name!r} is not there; topics that would do: {others}")


def _by_type(
    topics: list[BagTopic], sensor: Sensor, where: str, is_picture: Callable[[BagTopic], bool]
) -> BagTopic | None:
    fitting = candidates(topics, sensor)
    if sensor.word == "image":
        fitting = _without_twins([topic for topic in fitting if is_picture(topic)])
    elif fitting:  # the best type there is; for images both types are equally good
        best = min(sensor.ros_types.index(topic.type_name) for topic in fitting)
        fitting = [topic for topic in fitting if topic.type_name == sensor.ros_types[best]]
    if len(fitting) > 1:
        names = ", ".join(f"{topic.name} ({topic.count} messages)" for topic in fitting)
        raise UserError(
            f"{where}: has several topics for {sensor.word}: {names}; choose one with "
            f'{sensor.word}_topic = "{fitting[0].name}", or none with without = ["{sensor.word}"]'
        )
    return fitting[0] if fitting else None


def candidates(topics: list[BagTopic], sensor: Sensor) -> list[BagTopic]:
    """Topics whose type and name fit a sensor."""
    unfit = {"pose": _NOT_POSES, "image": _NOT_IMAGES}.get(sensor.word, ())
    return [
        topic
        for topic in topics
        if topic.type_name in sensor.ros_types
        and topic.count
        and not any(word in topic.name.lower() for word in unfit)
    ]


def _without_twins(images: list[BagTopic]) -> list[BagTopic]:
    """The same picture raw and compressed counts once; the compressed bytes are what we pass on."""
    names = {topic.name for topic in images}
    return [topic for topic in images if f"{topic.name}/compressed" not in names]


def choose_camera_info(topics: list[BagTopic], image: BagTopic, chosen: str, where: str) -> BagTopic | None:
    """The CameraInfo that belongs to an image topic; None if there is none.

    Raises:
        UserError: the chosen one is not there, or several would do.
    """
    infos = [topic for topic in topics if topic.type_name == CAMERA_INFO and topic.count]
    names = ", ".join(topic.name for topic in infos) or "none"
    if chosen:
        found = [topic for topic in infos if topic.name in (chosen, "/" + chosen)]
        if not found:
            raise UserError(f"{where}: camera_info_topic = {chosen!r} is not there; there are: {names}")
        return found[0]
    beside = [topic for topic in infos if _folder(topic.name) in _ancestors(image.name)]
    if beside:  # the one that shares most of the path
        return max(beside, key=lambda topic: len(_folder(topic.name)))
    if len(infos) > 1:
        raise UserError(
            f"{where}: none of the CameraInfo topics lies beside {image.name}: {names}; choose one with "
            "camera_info_topic"
        )
    return infos[0] if infos else None


def _folder(name: str) -> str:
    return name.rsplit("/", 1)[0]


def _ancestors(name: str) -> set[str]:
    parts = name.split("/")
    return {"/".join(parts[:i]) for i in range(2, len(parts))}
