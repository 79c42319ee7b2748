"""Conversion of a ROS 2 robot's messages: select topics, find the calibration, then convert messages.

Nothing is published before the calibration is known, and no image whose size differs from the calibration.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.rig import RigFile, load_rig
from beamsplat.common.geometry.transforms import se3_to_se2
from beamsplat.common.recording import calibration as cal
from beamsplat.common.recording.camera_info import is_calibrated, read_camera_info
from beamsplat.common.recording.image_reading import image_size_px, is_camera_image
from beamsplat.common.recording.input_report import InputFault, InputReport, reason_of
from beamsplat.common.recording.ros_types import deserialize, stamp_ns_of
from beamsplat.common.recording.sensor_reading import SensorReading
from beamsplat.common.recording.sensors import SENSORS, build_message
from beamsplat.common.recording.static_frames import MAX_FRAMES, normalize_frame
from beamsplat.common.recording.transform_reading import TransformReading, namespace_of, valid_transforms
from beamsplat.common.scans.clocks import (
    clock_offsets_s,
    clock_sentence,
    delay_doubts,
    prompt_lag_s,
    stamped_at_end,
)
from beamsplat.common.scans.laser import laser_of_ros
from beamsplat.common.scans.reader import ScanReader
from beamsplat.services.ros2.tf_odometry import TfOdometry
from beamsplat.services.ros2.topics import (
    CAMERA_INFO,
    SUPPORTED_TYPES,
    TF,
    kind_of,
    select_camera_info,
    select_topics,
)

_MAX_WAIT_S = 10.0  # for the first message of a topic that has a publisher
_MAX_TOPICS = 256  # of the robot that are considered, and of BeamSplat that are ignored
_MAX_REJECTING = 16  # topics whose unusable messages are counted apart
_OTHER = "other topics"
_MAX_SCAN_TOPICS = 8  # whose scans are learnt from before topics are selected
_DELAYS = 40  # messages of each topic whose delay is measured
_FIXED = 2e-3  # metres and rotation matrix entries: within it, a mount on /tf is fixed


@dataclass(frozen=True)
class RosRobotOptions:
    """Options that replace the automatic choice of topics, body frame and calibration."""

    topics: dict[str, str] = field(default_factory=dict)  # topic by kind
    camera_info_topic: str = ""
    body_frame: str = ""
    rig: Path | None = None
    without: frozenset[str] = frozenset()
    assume_mounts: bool = False
    settle_s: float = 2.0  # from the first message to topic selection


class RosRobot:
    """Converts serialised ROS 2 messages of one robot to messages of BeamSplat."""

    def __init__(self, options: RosRobotOptions) -> None:
        self._options = options
        self._publisher_types: dict[str, str] = {}  # ROS type by topic, of topics with a publisher
        self._ignored: deque[str] = deque(maxlen=_MAX_TOPICS)
        self._first_messages: dict[str, tuple[str, Any]] = {}  # (ROS type, first message) by sensor topic
        self._camera_infos: dict[str, Any] = {}
        self._transforms = TransformReading(InputReport())
        self._watched: dict[tuple[str, str], np.ndarray] = {}  # of the mounts: (parent, child) -> T on /tf
        self._watched_space = ""  # namespace of the topics with these transforms
        self._moved = ""  # why the mounts are not fixed
        self._scan_readers: dict[str, ScanReader] = {}  # by topic, which learn before topics are selected
        self._delays: dict[str, tuple[list[int], list[int]]] = {}  # receive times and stamps, by topic
        self._tf_odometry = TfOdometry()  # of /tf
        self._odometry_edge: tuple[str, str] | None = None  # (odom, child) if odometry is taken from /tf
        self._first_message_s: float | None = None
        self._kind_by_topic: dict[str, str] = {}  # sensor kind by selected topic
        self._T_child_body = np.eye(4)
        self.rig: RigFile | None = None
        self.published: Counter[str] = Counter()
        self.rejected: Counter[str] = Counter()  # unusable messages, by topic
        self.report = InputReport()  # of messages of the selected topics that were repaired or refused
        self._reading: SensorReading | None = None  # once the calibration is known
        self._info_topic = ""
        self.fault = ""
        self.notes: list[str] = []  # why topics were chosen
        self.doubts: list[str] = []  # about the calibration
        self.status = "no message received yet"

    @property
    def selected_topics(self) -> dict[str, str]:
        """Return topic -> sensor kind ("image", "scan", ...); empty before topic selection."""
        return dict(self._kind_by_topic)

    @property
    def needs_tf(self) -> bool:
        """Return whether /tf is needed: for calibration, odometry, and to see that mounts are fixed."""
        return self.rig is None or self._odometry_edge is not None or bool(self._watched)

    def add_publisher(self, topic: str, type_name: str) -> None:
        """Register a topic that has a publisher on the robot; beyond `_MAX_TOPICS` it is only counted."""
        if type_name not in SUPPORTED_TYPES:
            return
        if topic in self._publisher_types or len(self._publisher_types) < _MAX_TOPICS:
            self._publisher_types[topic] = type_name
        else:
            self._reject(topic, f"the robot has more than {_MAX_TOPICS} topics")

    def ignore_topic(self, topic: str) -> None:
        """Ignore a topic that is not published by the robot itself."""
        if topic not in self._ignored:
            self._ignored.append(topic)
        self._first_messages.pop(topic, None)
        self._camera_infos.pop(topic, None)

    def convert(
        self, topic: str, type_name: str, data: bytes, received_ns: int, now_s: float
    ) -> list[tuple[str, Any]]:
        """Convert one ROS message; return the resulting (topic, message) pairs of BeamSplat, possibly none.

        Args:
            topic, type_name: topic and type of the ROS message.
            data: the serialised message (CDR).
            received_ns: time of reception, used as stamp for messages without a stamp.
            now_s: reading of `time.monotonic` at reception.

        Raises:
            UserError: contradicting topics or calibration; one sentence.
        """
        if topic in self._ignored:
            return []
        try:
            message = deserialize(data, type_name)
        except ValueError as error:
            self._reject(topic, str(error))
            return []
        if self.rig is None:
            self._keep_for_calibration(topic, type_name, message, received_ns, now_s)
            return self._rig_message(received_ns, now_s)
        if type_name == TF:
            self._watch_mounts(topic, message)
            return self._odometry_from_tf(topic, message)
        if topic == self._info_topic and self._reading is not None:
            self._reading.images.add_camera_info(message)
            return []
        kind = self._kind_by_topic.get(topic)
        return self._convert(topic, kind, message, received_ns) if kind else []

    def _keep_for_calibration(
        self, topic: str, type_name: str, message: Any, received_ns: int, now_s: float
    ) -> None:
        """Store transforms, the newest CameraInfo and the first sensor message of each topic."""
        if type_name == TF:
            self._add_transforms(topic, message)
            return
        known = topic in self._camera_infos or topic in self._first_messages
        if not known and len(self._camera_infos) + len(self._first_messages) >= _MAX_TOPICS:
            self._reject(topic, f"the robot has more than {_MAX_TOPICS} topics")
        elif type_name == CAMERA_INFO:
            self._camera_infos[topic] = message
        else:
            self._first_messages.setdefault(topic, (type_name, message))
            self._first_message_s = now_s if self._first_message_s is None else self._first_message_s
            self._observe(topic, type_name, message, received_ns)

    def _observe(self, topic: str, type_name: str, message: Any, received_ns: int) -> None:
        """Learn from a sensor's message before topics are selected: how scans are to be read, its clock."""
        received, stamps = self._delays.setdefault(topic, ([], []))
        if len(received) < _DELAYS:
            received.append(received_ns)
            stamps.append(stamp_ns_of(message.header.stamp))
        if type_name in SENSORS["scan"].ros_types:
            reader = self._scan_readers.get(topic)
            if reader is None and len(self._scan_readers) < _MAX_SCAN_TOPICS:
                reader = self._scan_readers[topic] = ScanReader(topic, self.report)
            if reader is not None:
                reader.observe(laser_of_ros(message, received_ns))

    def _rig_message(self, received_ns: int, now_s: float) -> list[tuple[str, Any]]:
        """Return the calibration as [("rig", message)] once it is complete; until then []."""
        if (
            self._first_message_s is None
            or not self._all_topics_seen(now_s - self._first_message_s)
            or not self._calibrate()
        ):
            return []
        stamps_ns = (self._stamp_ns(message, received_ns) for _, message in self._first_messages.values())
        stamp_ns = max(min(stamps_ns), 0)
        for stored in (
            self._first_messages, self._camera_infos, self._publisher_types, self._scan_readers, self._delays,
        ):  # fmt: skip
            stored.clear()  # not used any more
        assert self.rig is not None  # set by `_calibrate`
        return [("rig", self.rig.message(stamp_ns, self.rig.source))]

    def _all_topics_seen(self, waited_s: float) -> bool:
        silent = [
            topic for topic, type_name in self._publisher_types.items()
            if type_name not in (CAMERA_INFO, TF) and topic not in self._first_messages
        ]  # fmt: skip
        self.status = f"receiving the robot's topics: {', '.join(sorted(self._first_messages))}"
        return waited_s >= self._options.settle_s and (not silent or waited_s >= _MAX_WAIT_S)

    def _calibrate(self) -> bool:
        """Select topics and find the calibration; return False, with a reason in `status`, if incomplete."""
        seen = {
            t: k
            for t, (k, m) in self._first_messages.items()
            if "image" not in kind_of(k) or is_camera_image(m)
        }
        seen |= dict.fromkeys(self._camera_infos, CAMERA_INFO)
        chosen, self.notes = select_topics(seen, self._options.topics, self._options.without)
        if "scan" not in chosen and "image" not in chosen:
            self.status = f"no scan or image among the topics: {', '.join(sorted(seen)) or 'none received'}"
            return False
        path = self._options.rig
        rig = self._rig_from_file(path, chosen) if path is not None else self._rig_from_robot(chosen)
        if rig is None:
            return False
        self._kind_by_topic = {topic: kind for kind, topic in chosen.items()}
        if "odometry" not in chosen and "odometry" not in self._options.without:
            self._odometry_edge = self._tf_odometry.odometry_edge()
        self.rig = rig
        if rig.lidar is not None:
            where = str(path) if path is not None else f"the robot: {chosen.get('scan', '')}"
            self.doubts += filter(None, [cal.check_lidar_plane(rig.lidar.model().T_body_lidar, where)])
        offsets_s = self._offsets_s(chosen)
        self._reading = SensorReading(
            self.report, chosen, self._info_topic, self._T_child_body,
            self._scan_reader(chosen, rig, offsets_s), offsets_s,
        )  # fmt: skip
        if rig.camera is not None:
            follow = path is None and self._info_topic != ""
            self._reading.images.calibrate(rig.camera.model_dump(exclude={"mount"}), follow=follow)
        self._update_status()
        return True

    def _offsets_s(self, chosen: dict[str, str]) -> dict[str, float]:
        """Return seconds to add to the stamps of sensors that are on another clock than the others."""
        lags = {kind: prompt_lag_s(*self._delays.get(topic, ([], []))) for kind, topic in chosen.items()}
        reader = self._scan_readers.get(chosen.get("scan", ""))
        expected = {}
        if reader is not None and reader.learner.facts is not None:
            facts = reader.learner.facts
            expected["scan"] = abs(facts.sweep_candidates_s[0])
            if stamped_at_end(facts.lag_s, expected["scan"]):
                expected["scan"] = facts.lag_s
            if reader.learner.rules().use_received:
                lags.pop("scan")
        known = {kind: lag for kind, lag in lags.items() if lag is not None}
        offsets_s = clock_offsets_s(known, expected)
        self.doubts += delay_doubts(known, expected, offsets_s, chosen)
        return offsets_s

    def _scan_reader(
        self, chosen: dict[str, str], rig: RigFile, offsets_s: dict[str, float]
    ) -> ScanReader | None:
        """Return the reader of the selected scans, with what it has learnt so far."""
        topic = chosen.get("scan")
        if topic is None:
            return None
        reader = self._scan_readers.get(topic, ScanReader(topic, self.report))
        section = None if rig.lidar is None else rig.lidar.scan
        offset_s = offsets_s.get("scan", 0.0)
        if section is not None or offset_s:
            reader = ScanReader(topic, self.report, section)
        if offset_s:
            stamp_ns = stamp_ns_of(self._first_messages[topic][1].header.stamp)
            reader.set_offset(round(offset_s * 1e9), clock_sentence(topic, stamp_ns, offset_s))
        if rig.lidar is not None:
            reader.set_mount(rig.lidar.model().T_body_lidar)
        return reader

    def _rig_from_file(self, path: Path, chosen: dict[str, str]) -> RigFile:
        rig = load_rig(path)
        for kind, sensor in (("image", "camera"), ("scan", "lidar")):
            if kind in chosen and getattr(rig, sensor) is None:
                raise UserError(
                    f"{self._options.rig}: [{sensor}] is missing, but the robot publishes {chosen[kind]}; "
                    f'add it, or set without = ["{kind}"]'
                )
        return rig.model_copy(update={"source": rig.source or str(self._options.rig)})

    def _rig_from_robot(self, chosen: dict[str, str]) -> RigFile | None:
        found = cal.Calibration()
        frames = {
            sensor: normalize_frame(self._first_messages[chosen[kind]][1].header.frame_id)
            for sensor, kind in (("camera", "image"), ("lidar", "scan"))
            if kind in chosen
        }
        child = ""
        if "odometry" in chosen:
            child = normalize_frame(self._first_messages[chosen["odometry"]][1].child_frame_id)
        elif (edge := self._tf_odometry.odometry_edge()) is not None:
            child = edge[1]
        sensor_topic = chosen.get("scan") or chosen["image"]
        tree, beside = self._transforms.tree(sensor_topic, constant=False)
        if not tree.names or any(tree.find(child or f, f) is None for f in frames.values()):
            fixed, (tree, beside) = tree, self._transforms.tree(sensor_topic, constant=True)
        else:
            fixed = tree
        cal.find_mounts(
            found, tree, frames, child, self._options.body_frame, self._options.assume_mounts, beside
        )
        if "image" in chosen:
            self._intrinsics(found, chosen["image"])
        if found.missing:
            self.status = (
                f"calibration is missing: {'; '.join(found.missing)}; or give a rig file (rig = ...)"
            )
            return None
        if child and found.body_frame:
            T_child_body = tree.find(child, found.body_frame)
            self._T_child_body = np.eye(4) if T_child_body is None else T_child_body
        for frame in frames.values():
            for pair in tree.pairs_between(found.body_frame, frame):
                T = tree.value(*pair)
                if T is not None and fixed.value(*pair) is None:
                    self._watched[pair] = T
        self._watched_space = sensor_topic
        self.doubts = [*found.doubts, *self._transforms.report.sentences]
        return found.rig("the robot's CameraInfo and transforms")

    def _intrinsics(self, found: cal.Calibration, image: str) -> None:
        info = select_camera_info(image, list(self._camera_infos), self._options.camera_info_topic)
        if info is None:
            found.missing.append(f"no sensor_msgs/CameraInfo was received for {image}")
            return
        size = image_size_px(self._first_messages[image][1])
        if size is None:
            found.missing.append(f"the first image of {image} is neither JPEG nor PNG")
            del self._first_messages[image]
            return
        message = self._camera_infos[info]
        read = read_camera_info(message, size, image, "the robot") if is_calibrated(message) else None
        found.add_intrinsics(read, info)
        self._info_topic = info

    def _convert(self, topic: str, kind: str, message: Any, received_ns: int) -> list[tuple[str, Any]]:
        assert self._reading is not None  # topics are selected
        refused = self.report.count("refused", topic)
        if self._moved and kind in ("scan", "image"):
            self.report.refused(topic, InputFault("transform", "", self._moved, "hold the mount still"))
            self._reject(topic, self._moved)
            return []
        built = self._reading.read(kind, message, received_ns)
        if self.report.count("refused", topic) > refused:
            self._reject(topic, self.report.last_refusal)
        self.published[topic] += len(built)
        self._update_status()
        return [(SENSORS[kind].topic, message) for message in built]

    def _add_transforms(self, topic: str, message: Any) -> None:
        ignored = self._transforms.ignored
        for stamped, _ in self._transforms.add(topic, message):
            if not topic.endswith("tf_static"):
                self._tf_odometry.add_edge(stamped.header.frame_id, stamped.child_frame_id)
        if self._transforms.ignored > ignored:
            self._reject(topic, f"transforms to more than {MAX_FRAMES} frames are ignored")

    def _watch_mounts(self, topic: str, message: Any) -> None:
        """Note when a transform of a mount changes that was taken from /tf because it had not changed."""
        if not self._watched or self._moved or topic.endswith("tf_static"):
            return
        if not ("/" + self._watched_space.strip("/")).startswith(namespace_of(topic) + "/"):
            return
        for stamped, T in valid_transforms(topic, message, self._transforms.report):
            pair = normalize_frame(stamped.header.frame_id), normalize_frame(stamped.child_frame_id)
            known = self._watched.get(pair)
            if known is not None and not np.allclose(known, T, atol=_FIXED, rtol=0.0):
                self._moved = f"the mount moves: the transform {pair[0]} -> {pair[1]} on {topic} has changed"

    def _odometry_from_tf(self, topic: str, message: Any) -> list[tuple[str, Any]]:
        """Return wheel odometry computed from a message of /tf; [] if there is an Odometry topic."""
        found = []
        for stamped, T in valid_transforms(topic, message, self._transforms.report):
            edge = normalize_frame(stamped.header.frame_id), normalize_frame(stamped.child_frame_id)
            if edge != self._odometry_edge or topic.endswith("tf_static"):
                continue
            stamp = stamped.header.stamp
            source = next((name for name, kind in self._kind_by_topic.items() if kind == "odometry"), topic)
            if topic != source:  # of another robot with the same names of frames
                self._reject(topic, f"odometry is taken from {source}")
                continue
            fields = self._tf_odometry.odometry_fields(int(stamp.sec) * 10**9 + int(stamp.nanosec), T)
            if fields is None:
                continue
            cal.move_odometry_to_body(fields, self._T_child_body)
            if self._reading is not None:
                self._reading.scans.add_odometry(fields["stamp_ns"], se3_to_se2(fields["T_odom_body"]))
            try:
                found.append((SENSORS["odometry"].topic, build_message(SENSORS["odometry"].topic, fields)))
            except ValueError as error:
                self._reject(topic, reason_of(error))
                continue
            self._kind_by_topic[topic] = "odometry"
            self.published[topic] += 1
            self._update_status()
        return found

    def _reject(self, topic: str, reason: str) -> None:
        listed = topic in self.rejected or len(self.rejected) < _MAX_REJECTING
        self.rejected[topic if listed else _OTHER] += 1
        self.fault = f"{topic}: {reason}"
        if self.rig is not None:
            self._update_status()

    def _update_status(self) -> None:
        counts = ", ".join(f"{topic} {self.published[topic]}" for topic in sorted(self._kind_by_topic))
        rejected = f"; {self.rejected.total()} rejected, last: {self.fault}" if self.rejected else ""
        repaired = [found for found in self.report.findings if found.action == "repaired"]
        if repaired:
            rejected += f"; {self.report.count('repaired')} repaired, for example {repaired[0].reason}"
        scans = [] if self._reading is None else self._reading.scans.warnings
        doubts = "".join(f"; {doubt}" for doubt in [*self.doubts, *scans])
        self.status = f"from ROS 2: {counts}{rejected}{doubts}"

    def _stamp_ns(self, message: Any, received_ns: int) -> int:
        stamp = message.header.stamp
        return int(stamp.sec) * 10**9 + int(stamp.nanosec) or received_ns
