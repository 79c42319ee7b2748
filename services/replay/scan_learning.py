"""A first pass over the scans and odometry of a bag: how its scans are to be read, and offsets of clocks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from beamsplat.common.geometry.rig import ScanSection
from beamsplat.common.geometry.transforms import se3_to_se2
from beamsplat.common.recording import calibration as cal
from beamsplat.common.recording.input_report import InputReport
from beamsplat.common.recording.sensors import ros_fields
from beamsplat.common.scans.clocks import (
    clock_offsets_s,
    clock_sentence,
    delay_doubts,
    prompt_lag_s,
    stamped_at_end,
)
from beamsplat.common.scans.header_rules import learn_header
from beamsplat.common.scans.laser import LaserMessage, laser_of_ros
from beamsplat.common.scans.reader import ScanReader
from beamsplat.services.replay.bags import Bag, BagTopic
from beamsplat.services.replay.decode import deserialize, header_stamp_ns

_LAGS = 40  # messages of each topic whose delay is measured


def learn_offsets(bag: Bag, chosen: dict[str, BagTopic]) -> tuple[dict[str, float], list[str]]:
    """Return seconds to add to the stamps of sensors on another clock, and sentences on their delays."""
    lags: dict[str, float] = {}
    expected: dict[str, float] = {}
    for sensor_name, topic in chosen.items():
        at, stamps, scans = [], [], []
        for raw in bag.messages([topic.name]):
            stamp_ns = header_stamp_ns(raw)
            if stamp_ns is not None:
                at.append(raw.at_ns)
                stamps.append(stamp_ns)
            if sensor_name == "scan":
                try:
                    scans.append(laser_of_ros(deserialize(raw), raw.at_ns))
                except ValueError:
                    continue
            if len(at) >= _LAGS:
                break
        if scans:
            rules, facts = learn_header(scans)
            if rules.use_received:  # by the receive times, which have no offset
                continue
            expected["scan"] = abs(facts.sweep_candidates_s[0])
            if stamped_at_end(facts.lag_s, expected["scan"]):
                expected["scan"] = facts.lag_s
        lag = prompt_lag_s(at, stamps)
        # Delays that vary by more than a second are no offset.
        if lag is not None and abs(float(np.median(np.array(at) - np.array(stamps))) / 1e9 - lag) < 1.0:
            lags[sensor_name] = lag
    offsets_s = clock_offsets_s(lags, expected)
    names = {sensor_name: topic.name for sensor_name, topic in chosen.items()}
    return offsets_s, delay_doubts(lags, expected, offsets_s, names)


def learn_scans(
    bag: Bag,
    chosen: dict[str, BagTopic],
    section: ScanSection | None,
    T_body_lidar: np.ndarray | None,
    T_child_body: np.ndarray,
    offsets_s: dict[str, float],
) -> ScanReader:
    """Return a reader that has learnt the rules of the bag's scans.

    Args:
        bag: the bag.
        chosen: topics by sensor; "scan" is one of them.
        section: values of a rig file, which are not found out.
        T_body_lidar: [4, 4] by the transforms; None = unknown.
        T_child_body: [4, 4], from the child frame of the odometry to the body.
        offsets_s: of the clocks, see `learn_offsets`.
    """
    topic = chosen["scan"].name
    reader = ScanReader(topic, InputReport(), section)
    if T_body_lidar is not None:
        reader.set_mount(T_body_lidar)
    if offset_s := offsets_s.get("scan", 0.0):
        first = next((header_stamp_ns(raw) for raw in bag.messages([topic])), 0) or 0
        reader.set_offset(round(offset_s * 1e9), clock_sentence(topic, first, offset_s))
    reader.learn(_measurements(bag, chosen, T_child_body, round(offsets_s.get("odometry", 0.0) * 1e9)))
    return reader


def _measurements(
    bag: Bag, chosen: dict[str, BagTopic], T_child_body: np.ndarray, offset_ns: int
) -> Iterator[LaserMessage | tuple[int, np.ndarray]]:
    odometry = chosen["odometry"].name if "odometry" in chosen else ""
    names = [chosen["scan"].name, *([odometry] if odometry else [])]
    for raw in bag.messages(names):
        try:
            message = deserialize(raw)
            if raw.topic != odometry:
                yield laser_of_ros(message, raw.at_ns)
                continue
            fields = ros_fields("wheel/odometry", message)
            cal.move_odometry_to_body(fields, T_child_body)
        except ValueError:  # counted when the bag is played
            continue
        yield (fields["stamp_ns"] or raw.at_ns) + offset_ns, se3_to_se2(fields["T_odom_body"])
