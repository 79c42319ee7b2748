"""Inspection of a bag, a recording or a folder for the command `beamsplat info`."""

from __future__ import annotations

from collections import defaultdict
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.recording import is_recording
from beamsplat.common.recording.sensors import SENSORS
from beamsplat.services.replay.bag_files import looks_like_bag
from beamsplat.services.replay.bag_source import BagSource
from beamsplat.services.replay.bags import Bag, BagTopic
from beamsplat.services.replay.decode import begins_with_header, header_stamp_ns
from beamsplat.services.replay.folder import FolderSource, looks_like_folder
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.recording_source import RecordingSource
from beamsplat.services.replay.source import data_path
from beamsplat.services.replay.statistics import (
    LidarStatistics,
    TopicStatistics,
    lidar_problems,
    lidar_statistics,
    topic_problems,
    topic_statistics,
)

_SCANS_SAMPLED = 300  # scans sampled for the statistics


@dataclass
class InspectionReport:
    """Everything that `beamsplat info` prints. `error`: the reason why the data cannot be played, or ""."""

    path: str
    kind: str
    bytes: int = 0
    start_ns: int = 0
    end_ns: int = 0
    topics: list[TopicStatistics] = field(default_factory=list)
    sensors: dict[str, str] = field(default_factory=dict)  # sensor name -> topic or file
    lidar: LidarStatistics | None = None
    camera: dict[str, Any] | None = None
    choices: list[str] = field(default_factory=list)  # why topics were chosen, where there were several
    calibration_found: list[str] = field(default_factory=list)
    calibration_assumed: list[str] = field(default_factory=list)
    calibration_missing: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    input: list[dict[str, Any]] = field(
        default_factory=list
    )  # repaired and refused messages, see InputReport
    error: str = ""

    @property
    def duration_s(self) -> float:
        return (self.end_ns - self.start_ns) / 1e9

    def as_dict(self) -> dict[str, Any]:
        """Return the report as a dictionary for JSON."""
        return {**asdict(self), "duration_s": self.duration_s}


def inspect(path: Path, options: SourceOptions) -> InspectionReport:
    """Return the report on the data at `path`.

    Raises:
        UserError: there are no readable data at `path`.
    """
    path = data_path(path)
    if not path.exists():
        raise UserError(f"{path}: no such file or folder; check the path")
    if not is_recording(path) and not looks_like_bag(path) and looks_like_folder(path):
        return _inspect_folder(path, options)
    return _inspect_bag(path, options, own=is_recording(path))


def _inspect_bag(path: Path, options: SourceOptions, *, own: bool) -> InspectionReport:
    with Bag(path, allow_truncated=own or options.allow_truncated) as bag:
        report = InspectionReport(
            str(path), "recording" if own else _kind(bag), _size(path), bag.start_ns, bag.end_ns
        )
        report.topics = _statistics_of_topics(bag)
        source: Any = None
        try:
            source = RecordingSource(path, options) if own else BagSource(bag, options)
            _describe(report, source.rig())
        except UserError as error:
            report.error = str(error)
        if own:
            report.problems += _describe_recording(report, source)
        else:
            _describe_bag(report, bag, source, options)
        names = set(report.sensors.values())
        for facts in report.topics:
            if facts.name in names:
                report.problems += topic_problems(facts)
        if report.lidar is not None:
            report.problems += lidar_problems(report.lidar)
        before = [] if source is not None else bag.problems  # contained in the problems of the source
        report.problems = list(dict.fromkeys([*before, *report.problems]))
        return report


def _describe_recording(report: InspectionReport, source: RecordingSource | None) -> list[str]:
    """Add sensors and lidar of a recording to the report; return the problems found."""
    if source is None:
        return []
    report.sensors = {sensor_name: f"/{SENSORS[sensor_name].topic}" for sensor_name in source.sensor_names}
    if "image" in report.sensors:  # the ROS topic of the images
        names = [facts.name for facts in report.topics if facts.name.startswith("/camera/image")]
        report.sensors["image"] = names[0] if names else report.sensors["image"]
    if "scan" in source.sensor_names:
        report.lidar = lidar_statistics(source.sample("scan", _SCANS_SAMPLED))
    problems = source.problems
    source.close()
    return problems


def _describe_bag(
    report: InspectionReport, bag: Bag, source: BagSource | None, options: SourceOptions
) -> None:
    """Add sensors, lidar and calibration of a ROS bag to the report, even if it cannot be played."""
    if source is None:
        try:
            source = BagSource(bag, SourceOptions(**{**vars(options), "require": frozenset()}))
        except UserError:  # already in report.error
            return
    report.sensors = {sensor_name: topic.name for sensor_name, topic in source.chosen.items()}
    report.choices = source.choices
    try:
        found = source.calibrate()
        if options.rig is None:
            report.calibration_found = found.found
        report.calibration_assumed = report.calibration_assumed or found.assumed
        report.calibration_missing = found.missing
    except UserError as error:
        report.calibration_missing = [str(error)]
    if "image" in source.chosen:
        first = source.sample("image", 1)
        report.camera = {
            **{k: first[0].get(k) for k in ("width_px", "height_px", "encoding")},
            **(report.camera or {}),
        }
    with suppress(UserError):  # of the calibration, in `calibration_missing`; damage, found before
        every = max(1, source.chosen["scan"].count // _SCANS_SAMPLED) if "scan" in source.chosen else 1
        scans: list[dict[str, Any]] = []
        number = 0
        for _, topic, message in source.messages():  # as replay reads it: what it refuses is named here
            if topic == SENSORS["scan"].topic:
                number += 1
                if number % every == 0 and len(scans) < _SCANS_SAMPLED:
                    scans.append(vars(message))
        report.lidar = lidar_statistics(scans) if scans else None
    reader = source.scan_reader()
    if reader is not None:
        report.calibration_found.append(f"{reader.topic}: {reader.learner.evidence()}")
    report.input = source.report.as_dicts()
    report.problems += source.problems


def _describe(report: InspectionReport, rig: Any) -> None:
    """Add camera and calibration of the message `Rig` to the report."""
    report.calibration_assumed = list(rig.assumed)
    if rig.camera is not None:
        fields = {k: v for k, v in vars(rig.camera).items() if k != "T_body_camera"}
        report.camera = {
            **fields,
            "position_m": [round(float(v), 4) for v in rig.camera.T_body_camera[:3, 3]],
        }
        report.calibration_found.append(f"camera calibration ({rig.source})")
    if rig.lidar is not None:
        report.calibration_found.append(f"lidar mount ({rig.source})")


def _statistics_of_topics(bag: Bag) -> list[TopicStatistics]:
    """Return the statistics of all topics from one pass over the bag."""
    arrivals: dict[str, list[int]] = defaultdict(list)
    stamps: dict[str, list[int]] = defaultdict(list)
    topics: dict[str, BagTopic] = {topic.name: topic for topic in bag.topics}
    stamped = {topic.name for topic in bag.topics if begins_with_header(topic.type_name, topic.encoding)}
    for raw in bag.messages():
        arrivals[raw.topic].append(raw.at_ns)
        if raw.topic in stamped:
            stamp_ns = header_stamp_ns(raw)
            stamps[raw.topic].append(stamp_ns or raw.at_ns)
    return [
        topic_statistics(
            name, topic.type_name, np.array(arrivals[name], np.int64),
            np.array(stamps[name], np.int64) if stamps.get(name) else None,
        )
        for name, topic in topics.items()
        if not name.endswith("/fields") or not name.startswith("/beamsplat/")
    ]  # fmt: skip


def _inspect_folder(path: Path, options: SourceOptions) -> InspectionReport:
    source = FolderSource(path, SourceOptions(**{**vars(options), "require": frozenset()}))
    report = InspectionReport(str(path), "folder", _size(path), source.start_ns, source.end_ns)
    for sensor_name, stamps in source.stamps().items():
        facts = topic_statistics(sensor_name, SENSORS[sensor_name].topic, np.array(stamps, np.int64), None)
        report.topics.append(facts)
        report.sensors[sensor_name] = sensor_name
        report.problems += topic_problems(facts)
    try:
        _describe(report, FolderSource(path, options).rig())
    except UserError as error:
        report.error = str(error)
    scans = source.sample("scan", _SCANS_SAMPLED)
    if scans:
        report.lidar = lidar_statistics(scans)
        report.problems += lidar_problems(report.lidar, sparse=not (path / "scans.csv").exists())
    report.problems += source.problems
    return report


def _kind(bag: Bag) -> str:
    encodings = {topic.encoding for topic in bag.topics}
    if "ros1" in encodings:
        return "ROS 1 bag"
    storage = "sqlite" if any(bag.path.glob("*.db3")) or bag.path.suffix == ".db3" else "MCAP"
    return f"ROS 2 bag ({storage})"


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
