"""Selection of the camera, lidar and odometry topics: by type, or by option if several have the type."""

from __future__ import annotations

from collections.abc import Callable

from beamsplat.common.errors import UserError
from beamsplat.common.recording.sensors import SENSORS, SensorType
from beamsplat.services.replay.bags import BagTopic
from beamsplat.services.replay.options import SourceOptions

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
# Names of topics that are not measured poses, and of images that are not camera images.
_NOT_POSES = ("goal", "target", "waypoint", "initial", "plan", "setpoint", "click")
_NOT_IMAGES = ("depth", "disparity", "mask", "semantic")


def choose_topics(
    topics: list[BagTopic], options: SourceOptions, where: str, is_image: Callable[[BagTopic], bool]
) -> dict[str, BagTopic]:
    """Return the topic of each sensor ("image", "scan", ...); sensors without a topic are not in the result.

    Args:
        topics: all topics of the bag.
        options: contain the topics that the user has set.
        where: path of the data, for messages.
        is_image: returns whether a raw image topic has camera images (the first message is read).

    Raises:
        UserError: several topics are possible; a topic set by option is missing or has another type; or the
            topic of a required sensor is missing.
    """
    chosen: dict[str, BagTopic] = {}
    for sensor_name, sensor in SENSORS.items():
        if sensor_name in options.without:
            continue
        name = options.topic_for(sensor_name)
        topic = _named(topics, sensor, name, where) if name else _by_type(topics, sensor, where, is_image)
        if topic is not None:
            chosen[sensor_name] = topic
    for sensor_name in sorted(options.require - options.without):
        if sensor_name not in chosen:
            types = " or ".join(SENSORS[sensor_name].ros_types)
            there = ", ".join(f"{t.name} ({t.type_name})" for t in topics if t.count) or "nothing"
            raise UserError(
                f"{where}: has no {sensor_name}: no topic of type {types}; it has {there}. "
                f'Use another recording, or set without = ["{sensor_name}"] if it is not needed'
            )
    return chosen


def _named(topics: list[BagTopic], sensor: SensorType, name: str, where: str) -> BagTopic:
    found = [topic for topic in topics if topic.name == name or topic.name == "/" + name]
    fitting = [topic for topic in found if topic.type_name in sensor.ros_types and topic.count]
    if fitting:
        return fitting[0]
    others = ", ".join(t.name for t in topics if t.type_name in sensor.ros_types and t.count) or "none"
    if found:
        problem = f"is a {found[0].type_name}" if found[0].count else "has no messages"
        raise UserError(f"{where}: {sensor.name}_topic = {name!r} {problem}; possible topics: {others}")
    raise UserError(f"{where}: {sensor.name}_topic = {name!r} is not there; possible topics: {others}")


def _by_type(
    topics: list[BagTopic], sensor: SensorType, where: str, is_image: Callable[[BagTopic], bool]
) -> BagTopic | None:
    fitting = candidates(topics, sensor)
    if sensor.name == "image":
        fitting = _without_raw_duplicates([topic for topic in fitting if is_image(topic)])
    elif fitting:  # the preferred type; for images both types are equally good
        best = min(sensor.ros_types.index(topic.type_name) for topic in fitting)
        fitting = [topic for topic in fitting if topic.type_name == sensor.ros_types[best]]
    if len(fitting) > 1:
        names = ", ".join(f"{topic.name} ({topic.count} messages)" for topic in fitting)
        raise UserError(
            f"{where}: has several topics for {sensor.name}: {names}; choose one with "
            f'{sensor.name}_topic = "{fitting[0].name}", or none with without = ["{sensor.name}"]'
        )
    return fitting[0] if fitting else None


def candidates(topics: list[BagTopic], sensor: SensorType) -> list[BagTopic]:
    """Return the topics whose type and name match a sensor."""
    unfit = {"pose": _NOT_POSES, "image": _NOT_IMAGES}.get(sensor.name, ())
    return [
        topic
        for topic in topics
        if topic.type_name in sensor.ros_types
        and topic.count
        and not any(word in topic.name.lower() for word in unfit)
    ]


def _without_raw_duplicates(images: list[BagTopic]) -> list[BagTopic]:
    """Return the image topics, without raw image topics that also exist in compressed form."""
    names = {topic.name for topic in images}
    return [topic for topic in images if f"{topic.name}/compressed" not in names]


def choose_camera_info(topics: list[BagTopic], image: BagTopic, chosen: str, where: str) -> BagTopic | None:
    """Return the CameraInfo topic that belongs to an image topic; None if there is none.

    `chosen`: the topic set by option, or "".

    Raises:
        UserError: the topic set by option is missing, or several topics are possible.
    """
    infos = [topic for topic in topics if topic.type_name == CAMERA_INFO and topic.count]
    names = ", ".join(topic.name for topic in infos) or "none"
    if chosen:
        found = [topic for topic in infos if topic.name in (chosen, "/" + chosen)]
        if not found:
            raise UserError(f"{where}: camera_info_topic = {chosen!r} is not there; there are: {names}")
        return found[0]
    beside = [topic for topic in infos if _folder(topic.name) in _ancestors(image.name)]
    if beside:  # the one with the longest common namespace
        return max(beside, key=lambda topic: len(_folder(topic.name)))
    if len(infos) > 1:
        raise UserError(
            f"{where}: none of the CameraInfo topics is in the namespace of {image.name}: {names}; "
            "choose one with camera_info_topic"
        )
    return infos[0] if infos else None


def _folder(name: str) -> str:
    return name.rsplit("/", 1)[0]


def _ancestors(name: str) -> set[str]:
    parts = name.split("/")
    return {"/".join(parts[:i]) for i in range(2, len(parts))}
