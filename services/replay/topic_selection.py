"""Selection of a bag's topics of sensors, by the rules of common/recording/topic_choice.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from beamsplat.common.errors import UserError
from beamsplat.common.recording.sensors import SENSORS
from beamsplat.common.recording.topic_choice import Candidate, choose_topic, left_out_by_name
from beamsplat.services.replay.bags import BagTopic
from beamsplat.services.replay.options import SourceOptions


class SelectedTopics(NamedTuple):
    """The topic of each sensor that has one; sentences on choices, and on topics that cannot be used."""

    topics: dict[str, BagTopic]
    choices: list[str]
    unusable: list[str]


def select_topics(
    topics: list[BagTopic], options: SourceOptions, where: str, unusable: Callable[[BagTopic], str]
) -> SelectedTopics:
    """Return the topic of each sensor ("image", "scan", ...); sensors without a topic are not in the result.

    Args:
        topics: all topics of the bag.
        options: contain the topics that the user has set.
        where: path of the data, for messages.
        unusable: returns why an image topic has no camera images (the first message is read), or "".

    Raises:
        UserError: several topics are possible; a topic set by option is missing or has another type; or the
            topic of a required sensor is missing.
    """
    by_name = {topic.name: topic for topic in topics if topic.count}
    left_out: dict[str, str] = {}
    listed = []
    for topic in by_name.values():
        is_image = topic.type_name in SENSORS["image"].ros_types and "image" not in options.without
        why = unusable(topic) if is_image and not options.image_topic else ""
        if why:
            left_out[topic.name] = why
        else:
            listed.append(Candidate(topic.name, topic.type_name, topic.count))
    selected: dict[str, BagTopic] = {}
    choices: list[str] = []
    unused: list[str] = []
    for sensor_name in ("scan", "image", "odometry", "pose"):
        if sensor_name in options.without:
            continue
        near = selected["scan"].name if "scan" in selected else ""
        choice = choose_topic(sensor_name, listed, where, options.topic_for(sensor_name), near)
        if choice is None:
            continue
        selected[sensor_name] = by_name[choice.topic.name]
        if choice.reason and not options.topic_for(sensor_name):
            choices.append(f"{choice.topic.name} is {choice.reason}")
    if "image" not in selected and "image" not in options.without:
        left_out |= left_out_by_name(listed, "image")
        unused = [f"{name} is not used: {why}" for name, why in left_out.items()]
    for sensor_name in sorted(options.require - options.without):
        if sensor_name not in selected:
            raise UserError(_missing(sensor_name, topics, left_out, where))
    return SelectedTopics(selected, choices, unused)


def _missing(sensor_name: str, topics: list[BagTopic], left_out: dict[str, str], where: str) -> str:
    """Return the sentence on a required sensor without a topic: what there is instead."""
    types = " or ".join(SENSORS[sensor_name].ros_types)
    there = ", ".join(f"{t.name} ({t.type_name})" for t in topics if t.count) or "nothing"
    encodings = sorted({t.encoding for t in topics if t.count} - {"cdr", "ros1"})
    text = f"{where}: has no {sensor_name}: no topic of type {types}; it has {there}. "
    if encodings:
        text += (
            f"Its messages are encoded as {', '.join(encodings)}, and only those of ROS (cdr, ros1) are "
            "read: record or convert them as ROS messages. "
        )
    if sensor_name == "image" and left_out:
        text += " ".join(f"{name} is not used: {why}." for name, why in left_out.items()) + " "
    return text + f'Use another recording, or set without = ["{sensor_name}"] if it is not needed'
