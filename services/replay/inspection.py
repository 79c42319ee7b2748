"""What is in a bag, a recording or a folder: the report behind `beamsplat info`."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.recording import is_recording
from beamsplat.common.recording.sensors import SENSORS
from beamsplat.services.replay.bag_source import BagSource
from beamsplat.services.replay.bags import Bag, BagTopic, looks_like_bag
from beamsplat.services.replay.decode import begins_with_header, header_stamp_ns
from beamsplat.services.replay.folder import FolderSource, looks_like_folder
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.recording_source import RecordingSource
from beamsplat.services.replay.source import data_path
from beamsplat.services.replay.statistics import (
    LidarFacts,
    StreamFacts,
    lidar_facts,
    lidar_problems,
    stream_facts,
    stream_problems,
)

_SCANS_LOOKED_AT = 300


@dataclass
class Report:
    """Everything `info` prints. `error` says why it cannot be played as it is, or is empty."""

    path: str
    kind: str
    bytes: int = 0
    start_ns: int = 0
    end_ns: int = 0
    topics: list[StreamFacts] = field(default_factory=list)
    sensors: dict[str, str] = field(default_factory=dict)  # word -> topic or file
    lidar: LidarFacts | None = None
    camera: dict[str, Any] | None = None
    calibration_found: list[str] = field(default_factory=list)
    calibration_assumed: list[str] = field(default_factory=list)
    calibration_missing: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    error: str = ""

    @property
    def duration_s(self) -> float:
        return (self.end_ns - self.start_ns) / 1e9

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "duration_s": self.duration_s}


def inspect(path: Path, options: SourceOptions) -> Report:
    """The report on what lies at `path`.

    Raises:
        UserError: nothing that can be read at all.
    """
    path = data_path(path)
    if not path.exists():
        raise UserError(f"{path}: no such file or folder; check the path")
    if not is_recording(path) and not looks_like_bag(path) and looks_like_folder(path):
        return _inspect_folder(path, options)
    return _inspect_bag(path, options, own=is_recording(path))


def _inspect_bag(path: Path, options: SourceOptions, *, own: bool) -> Report:
    with Bag(path, allow_truncated=own or options.allow_truncated) as bag:
        report = Report(str(path), "recording" if own else _kind(bag), _size(path), bag.start_ns, bag.end_ns)
        report.topics = _topic_facts(bag)
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
                report.problems += stream_problems(facts)
        if report.lidar is not None:
            report.problems += lidar_problems(report.lidar)
        before = [] if source is not None else bag.problems  # a source repeats them
        report.problems = list(dict.fromkeys([*before, *report.problems]))
        return report


def _describe_recording(report: Report, source: RecordingSource | None) -> list[str]:
    """Sensors and lidar of one of our recordings; problems found on the way."""
    if source is None:
        return []
    report.sensors = {word: f"/{SENSORS[word].topic}" for word in source.words}
    if "image" in report.sensors:  # the ROS topic that carries it
        names = [facts.name for facts in report.topics if facts.name.startswith("/camera/image")]
        report.sensors["image"] = names[0] if names else report.sensors["image"]
    if "scan" in source.words:
        report.lidar = lidar_facts(source.sample("scan", _SCANS_LOOKED_AT))
    problems = source.problems
    source.close()
    return problems


def _describe_bag(report: Report, bag: Bag, source: BagSource | None, options: SourceOptions) -> None:
    """Sensors, lidar and calibration of a foreign bag, also where it cannot be played."""
    if source is None:
        try:
            source = BagSource(bag, SourceOptions(**{**vars(options), "require": frozenset()}))
        except UserError:  # said already in report.error
            return
    report.sensors = {word: topic.name for word, topic in source.chosen.items()}
    try:
        found = source.calibrate()
        if options.rig is None:
            report.calibration_found = found.found
        report.calibration_assumed = report.calibration_assumed or found.assumed
        report.calibration_missing = found.missing
    except UserError as error:
        report.calibration_missing = [str(error)]
    if "scan" in source.chosen:
        scans = source.sample("scan", _SCANS_LOOKED_AT)
        report.lidar = lidar_facts(scans) if scans else None
    if "image" in source.chosen:
        first = source.sample("image", 1)
        report.camera = {
            **{k: first[0].get(k) for k in ("width_px", "height_px", "encoding")},
            **(report.camera or {}),
        }
    report.problems += source.problems


def _describe(report: Report, rig: Any) -> None:
    """Camera and calibration as the message `Rig` has them."""
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


def _topic_facts(bag: Bag) -> list[StreamFacts]:
    """One pass over the bag: receive times and, where a message begins with a header, its stamp."""
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
        stream_facts(
            name, topic.type_name, np.array(arrivals[name], np.int64),
            np.array(stamps[name], np.int64) if stamps.get(name) else None,
        )
        for name, topic in topics.items()
        if not name.endswith("/fields") or not name.startswith("/beamsplat/")
    ]  # fmt: skip


def _inspect_folder(path: Path, options: SourceOptions) -> Report:
    source = FolderSource(path, SourceOptions(**{**vars(options), "require": frozenset()}))
    report = Report(str(path), "folder", _size(path), source.start_ns, source.end_ns)
    for word, stamps in source.stamps().items():
        facts = stream_facts(word, SENSORS[word].topic, np.array(stamps, np.int64), None)
        report.topics.append(facts)
        report.sensors[word] = word
        report.problems += stream_problems(facts)
    try:
        _describe(report, FolderSource(path, options).rig())
    except UserError as error:
        report.error = str(error)
    scans = source.sample("scan", _SCANS_LOOKED_AT)
    if scans:
        report.lidar = lidar_facts(scans)
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
