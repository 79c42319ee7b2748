"""Choice of a robot's topics by their type and name, as an expert would choose: for bags and for ROS 2.

Where several topics have the type of a sensor, the better one is used if the names say which it is, and the
choice is reported with its reason. Otherwise the user has to choose, and the error names the option.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from beamsplat.common.errors import UserError
from beamsplat.common.recording.camera_info import CAMERA_INFO, is_rectified
from beamsplat.common.recording.sensors import SENSORS, SensorType


class Candidate(NamedTuple):
    """A topic of a bag or robot; messages = 0: unknown (a running robot)."""

    name: str
    type_name: str
    messages: int = 0


@dataclass(frozen=True)
class TopicChoice:
    """The topic of a sensor, and why it was chosen: "" if it is the only one."""

    topic: Candidate
    reason: str = ""


# Words in the names of topics, by sensor. Excluded: not this sensor at all.
_EXCLUDED = {
    "pose": {"goal", "target", "waypoint", "initial", "initialpose", "plan", "setpoint", "click", "clicked"},
    "image": {"depth", "disparity", "mask", "semantic", "segmentation", "confidence", "compresseddepth"},
}
# The name of a device, which takes colour images too: /depth_cam/rgb, but not /depth_cam/depth.
_DEPTH_CAMERA = re.compile(r"(?<![^/_])depth_?cam(?:era)?(?=[/_0-9]|$)")
# Derived from the measurement of another sensor, or for display: used only if there is nothing else.
_DERIVED = {
    "scan": {"depth", "camera", "kinect", "virtual", "cloud", "pointcloud", "points", "fake", "simulated"},
    "image": {
        "infra", "infra1", "infra2", "ir", "thermal", "debug", "annotated", "detections", "overlay", "map",
        "preview", "matches", "features", "result", "output", "track",
    },
    "odometry": {
        "visual", "vo", "vio", "icp", "lidar", "laser", "rtabmap", "slam", "orb", "vins", "rf2o", "gps",
        "truth", "gt", "groundtruth", "ground", "map", "amcl",
    },
    "pose": set(),
}  # fmt: skip
# Better and worse variants of the same measurement.
_FILTERED = {"filtered", "filter", "fused"}
_WORSE = {"raw", "unfiltered", "throttle", "throttled", "downsampled", "sparse", "sampled", "old", "backup"}
_WHY_FILTERED = {"scan": "it is filtered: beams on the robot itself are removed"}
_LEAST_SHARE = 0.5  # of the messages of another topic: a better variant with fewer is not used
_TRANSPORTS = ("compressed", "theora", "ffmpeg", "zstd", "avif")


def choose_topic(
    sensor_name: str, topics: list[Candidate], where: str, named: str = "", near: str = ""
) -> TopicChoice | None:
    """Return the topic of a sensor; None if there is none.

    Args:
        sensor_name: "image", "scan", "odometry" or "pose".
        topics: all topics that have messages.
        where: name of the data or robot, for error texts.
        named: the topic set by option, or "".
        near: topic of another sensor of the same robot: topics in its namespace are preferred.

    Raises:
        UserError: several topics are possible, or the one set by option is missing or has another type.
    """
    sensor = SENSORS[sensor_name]
    if named:
        return TopicChoice(_named(topics, sensor, named, where), f"set by {sensor_name}_topic")
    fitting = candidates(topics, sensor_name)
    if len(fitting) <= 1:
        return TopicChoice(fitting[0]) if fitting else None
    kept, reasons = fitting, []
    rules = (_image_rules if sensor_name == "image" else _scan_rules)(sensor, topics)
    for reason, rule in (("it is in the namespace of " + near, _near(near)), *rules):
        better = rule(kept)
        if better and len(better) < len(kept):
            kept = better
            reasons.append(reason)
        if len(kept) == 1:
            others = ", ".join(topic.name for topic in fitting if topic is not kept[0])
            return TopicChoice(
                kept[0], f"used instead of {others}: {'; '.join(reasons)}; {sensor_name}_topic sets another"
            )
    names = ", ".join(
        f"{topic.name} ({topic.messages} messages)" if topic.messages else topic.name for topic in kept
    )
    raise UserError(
        f"{where}: has several topics for {sensor_name}: {names}; choose one with "
        f'{sensor_name}_topic = "{kept[0].name}" (--{sensor_name}-topic), or none with '
        f'without = ["{sensor_name}"]'
    )


def candidates(topics: list[Candidate], sensor_name: str) -> list[Candidate]:
    """Return the topics whose type and name match a sensor, by name."""
    types = SENSORS[sensor_name].ros_types
    return sorted(t for t in topics if t.type_name in types and not _excluding_words(t.name, sensor_name))


def left_out_by_name(topics: list[Candidate], sensor_name: str) -> dict[str, str]:
    """Return why topics of a sensor's type are not used for it, by topic: words in their names."""
    types = SENSORS[sensor_name].ros_types
    found = {t.name: _excluding_words(t.name, sensor_name) for t in sorted(topics) if t.type_name in types}
    return {
        name: f"its name contains {', '.join(map(repr, words))}; {sensor_name}_topic selects it nevertheless"
        for name, words in found.items()
        if words
    }


def _excluding_words(name: str, sensor_name: str) -> list[str]:
    words = _words(_DEPTH_CAMERA.sub("camera", name.lower()))
    return sorted(words & _EXCLUDED.get(sensor_name, set()))


def choose_camera_info(topics: list[Candidate], image: str, where: str, named: str = "") -> str | None:
    """Return the CameraInfo topic that belongs to an image topic; None if there is none.

    `named`: the topic set by option, or "".

    Raises:
        UserError: the topic set by option is missing, or several topics are possible.
    """
    infos = sorted(topic.name for topic in topics if topic.type_name == CAMERA_INFO)
    names = ", ".join(infos) or "none"
    if named:
        found = [name for name in infos if name.strip("/") == named.strip("/")]
        if not found:
            raise UserError(f"{where}: camera_info_topic = {named!r} is not there; there are: {names}")
        return found[0]
    parts = image.split("/")
    above = {"/".join(parts[:i]) for i in range(1, len(parts))}
    beside = [name for name in infos if name.rsplit("/", 1)[0] in above]
    if beside:  # the one with the longest common namespace
        return max(beside, key=lambda name: len(name.rsplit("/", 1)[0]))
    if len(infos) > 1:
        raise UserError(
            f"{where}: none of the CameraInfo topics is in the namespace of {image}: {names}; "
            "choose one with camera_info_topic (--camera-info-topic)"
        )
    return infos[0] if infos else None


Rule = Callable[[list[Candidate]], list[Candidate]]


def _scan_rules(sensor: SensorType, topics: list[Candidate]) -> tuple[tuple[str, Rule], ...]:
    """Return the rules for scans, odometry and poses, the most important one first."""

    def preferred_type(kept: list[Candidate]) -> list[Candidate]:
        best = min(sensor.ros_types.index(topic.type_name) for topic in kept)
        return [topic for topic in kept if sensor.ros_types.index(topic.type_name) == best]

    def filtered(kept: list[Candidate]) -> list[Candidate]:
        """Keep the filtered variants; each must be one of another topic, and have as many messages."""
        most = max(topic.messages for topic in kept)
        return [
            topic
            for topic in kept
            if _words(topic.name) & _FILTERED and topic.messages >= _LEAST_SHARE * most
        ] if _same_measurement(kept, sensor.name) else []  # fmt: skip

    def not_worse(kept: list[Candidate]) -> list[Candidate]:
        if not _same_measurement(kept, sensor.name):
            return []
        return [topic for topic in kept if not _words(topic.name) & (_WORSE | _FILTERED)]

    return (
        ("its type is preferred", preferred_type),
        ("the name of the others says that they are derived", _not_derived(sensor.name)),
        (_WHY_FILTERED.get(sensor.name, "it is filtered"), filtered),
        ("it is the usual topic", not_worse),
    )


def _image_rules(sensor: SensorType, topics: list[Candidate]) -> tuple[tuple[str, Rule], ...]:
    """Return the rules for images, the most important one first."""
    infos = [topic for topic in topics if topic.type_name == CAMERA_INFO]

    def one_transport(kept: list[Candidate]) -> list[Candidate]:
        names = {topic.name for topic in kept}
        return [topic for topic in kept if f"{topic.name}/compressed" not in names]

    def colour(kept: list[Candidate]) -> list[Candidate]:
        folders = {topic: _base(topic.name).rpartition("/")[0] for topic in kept}
        return [topic for topic in kept if _words(folders[topic]) & {"color", "colour", "rgb"}]

    def raw(kept: list[Candidate]) -> list[Candidate]:
        """Keep the images as the camera takes them, if all are of one camera and its K is known."""
        folders = {_base(topic.name).rsplit("/", 1)[0] for topic in kept}
        if len(folders) > 1:
            return []
        if not any(info.name.rsplit("/", 1)[0] in folders for info in infos):
            return [topic for topic in kept if is_rectified(topic.name)]
        return [topic for topic in kept if not is_rectified(topic.name)]

    def named_raw(kept: list[Candidate]) -> list[Candidate]:
        if len({_base(topic.name).rsplit("/", 1)[0] for topic in kept}) > 1:
            return []
        return [topic for topic in kept if _base(topic.name).endswith(("image_raw", "/raw"))]

    return (
        ("it is compressed", one_transport),
        ("the name of the others says that they are derived", _not_derived("image")),
        ("the images are in colour", colour),
        ("it is not rectified, and K belongs to it", raw),
        ("it is the image of the camera", named_raw),
    )


def _not_derived(sensor_name: str) -> Rule:
    words = _DERIVED[sensor_name]
    return lambda kept: [topic for topic in kept if not _words(topic.name) & words]


def _near(near: str) -> Rule:
    """Keep the topics that share most of the namespace of `near`."""
    folder = near.strip("/").split("/")[:-1]

    def rule(kept: list[Candidate]) -> list[Candidate]:
        shared = {}
        for topic in kept:
            parts = topic.name.strip("/").split("/")[:-1]
            shared[topic] = next(
                (i for i, (a, b) in enumerate(zip(folder, parts)) if a != b), min(len(folder), len(parts))
            )
        best = max(shared.values())
        return [topic for topic in kept if shared[topic] == best] if best else []

    return rule


def _same_measurement(kept: list[Candidate], sensor_name: str) -> bool:
    """Return whether the names differ only in words for variants, as /scan, /scan_raw, /scan/filtered."""
    bases = set()
    for topic in kept:
        words = [w for w in re.split(r"[/_]", topic.name.lower().strip("/")) if w not in _FILTERED | _WORSE]
        bases.add(tuple({"odometry": "odom"}.get(word, word) for word in words if word != "wheels"))
    return len(bases) == 1


def _base(name: str) -> str:
    """Return the name of an image topic without its transport."""
    folder, _, last = name.rpartition("/")
    return folder if last in _TRANSPORTS else name


def _words(name: str) -> set[str]:
    return set(re.split(r"[/_]", name.lower().strip("/")))


def _named(topics: list[Candidate], sensor: SensorType, name: str, where: str) -> Candidate:
    found = [topic for topic in topics if topic.name.strip("/") == name.strip("/")]
    for topic in found:
        if topic.type_name in sensor.ros_types:
            return topic
    others = ", ".join(sorted(t.name for t in topics if t.type_name in sensor.ros_types)) or "none"
    problem = f"is a {found[0].type_name}" if found else "is not there or has no messages"
    raise UserError(f"{where}: {sensor.name}_topic = {name!r} {problem}; possible topics: {others}")
