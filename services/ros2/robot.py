"""A ROS 2 robot's messages as ours: learns what there is, finds the calibration, then passes on.

Nothing goes out before the calibration is known, and no picture that it does not belong to.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.rig import RigFile, load_rig
from beamsplat.common.recording import calibration as cal
from beamsplat.common.recording.picture import is_whole
from beamsplat.common.recording.ros_types import deserialize, transform_of
from beamsplat.common.recording.sensors import SENSORS, build, ros_fields
from beamsplat.common.recording.static_frames import StaticFrames, clean
from beamsplat.services.ros2.moving import MovingFrames
from beamsplat.services.ros2.topics import CAMERA_INFO, PICTURES, TF, WANTED, camera_info_of, choose

_PATIENCE_S = 10.0  # for the first message of a topic that somebody publishes


@dataclass(frozen=True)
class RobotOptions:
    """What the user knows better."""

    topics: dict[str, str] = field(default_factory=dict)  # topic by word
    camera_info_topic: str = ""
    body_frame: str = ""
    rig: Path | None = None
    without: frozenset[str] = frozenset()
    assume_mounts: bool = False
    settle_s: float = 2.0  # from the first message until the topics are chosen


class Robot:
    """Takes serialised ROS 2 messages as they come."""

    def __init__(self, options: RobotOptions) -> None:
        self._options = options
        self._offered: dict[str, str] = {}  # type by topic: somebody publishes it
        self._ignored: set[str] = set()
        self._first: dict[str, tuple[str, Any]] = {}  # type and first message by sensor topic
        self._infos: dict[str, Any] = {}
        self._fixed = StaticFrames()  # from /tf_static
        self._steady = StaticFrames()  # these, and those of /tf that do not change
        self._moving = MovingFrames()  # of /tf
        self._wheels: tuple[str, str] | None = None  # (odom, child) where /tf stands for Odometry
        self._since_s: float | None = None
        self._words: dict[str, str] = {}  # word by chosen topic
        self._T_child_body = np.eye(4)
        self.rig: RigFile | None = None
        self.passed: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.fault = ""
        self.status = "nothing heard yet"

    @property
    def chosen(self) -> dict[str, str]:
        """Word by topic, once they are chosen."""
        return dict(self._words)

    @property
    def wants_frames(self) -> bool:
        """Whether /tf is of use: until the calibration is known, and where it holds the wheels' odometry."""
        return self.rig is None or self._wheels is not None

    def offer(self, topic: str, type_name: str) -> None:
        """Somebody says that it publishes there."""
        if type_name in WANTED:
            self._offered[topic] = type_name

    def ignore(self, topic: str) -> None:
        """What comes there is not the robot's."""
        self._ignored.add(topic)
        self._first.pop(topic, None)

    def take(
        self, topic: str, type_name: str, data: bytes, received_ns: int, now_s: float
    ) -> list[tuple[str, Any]]:
        """Our messages, with their topics, that this one leads to.

        Raises:
            UserError: topics or calibration contradict themselves; one sentence.
        """
        if topic in self._ignored:
            return []
        try:
            message = deserialize(data, type_name)
        except ValueError as error:
            self._refuse(topic, str(error))
            return []
        if type_name == TF and self.rig is not None:
            return self._odometry_of(topic, message)
        if type_name == TF:
            self._take_frames(topic, message)
        elif type_name == CAMERA_INFO:
            self._infos[topic] = message
        elif self.rig is None:
            self._first.setdefault(topic, (type_name, message))
            self._since_s = now_s if self._since_s is None else self._since_s
        if self.rig is None:
            if self._since_s is None or not self._settled(now_s) or not self._calibrate():
                return []
            stamp_ns = min(self._stamp_ns(m, received_ns) for _, m in self._first.values())
            return [("rig", self.rig.message(max(stamp_ns, 0), self.rig.source))]
        word = self._words.get(topic)
        return self._pass(topic, word, message, received_ns) if word else []

    def _settled(self, now_s: float) -> bool:
        waited_s = now_s - self._since_s
        silent = [
            topic for topic, kind in self._offered.items()
            if kind not in (CAMERA_INFO, TF) and topic not in self._first
        ]  # fmt: skip
        self.status = f"learning what the robot has: {', '.join(sorted(self._first))}"
        return waited_s >= self._options.settle_s and (not silent or waited_s >= _PATIENCE_S)

    def _calibrate(self) -> bool:
        """Chooses topics and finds the calibration; False, and the reason in `status`, if it is not there."""
        seen = {t: k for t, (k, m) in self._first.items() if "image" not in _word_of(k) or _is_picture(m)}
        chosen = choose(seen, self._options.topics, self._options.without)
        if "scan" not in chosen and "image" not in chosen:
            self.status = f"neither scan nor image among {', '.join(sorted(seen)) or 'what came'}"
            return False
        rig = self._given_rig(chosen) if self._options.rig is not None else self._found_rig(chosen)
        if rig is None:
            return False
        self._words = {topic: word for word, topic in chosen.items()}
        if "odometry" not in chosen and "odometry" not in self._options.without:
            self._wheels = self._moving.edge()
        self.rig = rig
        self._describe()
        return True

    def _given_rig(self, chosen: dict[str, str]) -> RigFile:
        rig = load_rig(self._options.rig)
        for word, sensor in (("image", "camera"), ("scan", "lidar")):
            if word in chosen and getattr(rig, sensor) is None:
                raise UserError(
                    f"{self._options.rig}: has no [{sensor}], but the robot has {chosen[word]}; "
                    f'add it, or set without = ["{word}"]'
                )
        return rig.model_copy(update={"source": rig.source or str(self._options.rig)})

    def _found_rig(self, chosen: dict[str, str]) -> RigFile | None:
        found = cal.Calibration()
        frames = {
            sensor: clean(self._first[chosen[word]][1].header.frame_id)
            for sensor, word in (("camera", "image"), ("lidar", "scan"))
            if word in chosen
        }
        child = ""
        if "odometry" in chosen:
            child = clean(self._first[chosen["odometry"]][1].child_frame_id)
        elif (edge := self._moving.edge()) is not None:
            child = edge[1]
        tree = self._fixed
        if not tree.names or any(tree.find(child or f, f) is None for f in frames.values()):
            tree = self._steady
        cal.find_mounts(found, tree, frames, child, self._options.body_frame, self._options.assume_mounts)
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
        return found.rig("the robot's CameraInfo and transforms")

    def _intrinsics(self, found: cal.Calibration, image: str) -> None:
        info = camera_info_of(image, list(self._infos), self._options.camera_info_topic)
        if info is None:
            found.missing.append(f"no sensor_msgs/CameraInfo has come for {image}")
            return
        fields = ros_fields("camera/image", self._first[image][1])
        if "width_px" not in fields:
            found.missing.append(f"{image} starts with a picture that is neither JPEG nor PNG")
            del self._first[image]
            return
        size = fields["width_px"], fields["height_px"]
        found.camera = cal.intrinsics(self._infos[info], size, image, "the robot")
        if found.camera is None:
            found.missing.append(f"K on {info} is all zero: this camera was never calibrated")

    def _pass(self, topic: str, word: str, message: Any, received_ns: int) -> list[tuple[str, Any]]:
        sensor = SENSORS[word]
        try:
            fields = ros_fields(sensor.topic, message)
            if fields["stamp_ns"] == 0:
                fields["stamp_ns"] = received_ns
            if word == "odometry":
                cal.to_body(fields, self._T_child_body)
            if word == "image":
                self._check_picture(fields)
            built = build(sensor.topic, fields)
        except ValueError as error:
            self._refuse(topic, _first_line(error))
            return []
        self.passed[topic] += 1
        self._describe()
        return [(sensor.topic, built)]

    def _check_picture(self, fields: dict[str, Any]) -> None:
        camera = self.rig.camera
        size = fields.get("width_px"), fields.get("height_px")
        if None in size or (fields["encoding"] in ("jpeg", "png") and not is_whole(fields["data"].data)):
            raise ValueError("the picture is broken")
        if camera is not None and size != (camera.width_px, camera.height_px):
            raise ValueError(
                f"the picture is {size[0]}x{size[1]} px, K is for {camera.width_px}x{camera.height_px} px"
            )

    def _take_frames(self, topic: str, message: Any) -> None:
        fixed = topic.endswith("tf_static")
        for stamped, T in _transforms(message):
            if not fixed:
                self._moving.note(stamped.header.frame_id, stamped.child_frame_id)
            for tree in (self._fixed, self._steady) if fixed else (self._steady,):
                tree.add(stamped.header.frame_id, stamped.child_frame_id, T, replace=fixed)

    def _odometry_of(self, topic: str, message: Any) -> list[tuple[str, Any]]:
        """The wheels' odometry in a message of /tf, where nothing better says it."""
        found = []
        for stamped, T in _transforms(message):
            edge = clean(stamped.header.frame_id), clean(stamped.child_frame_id)
            if edge != self._wheels or topic.endswith("tf_static"):
                continue
            stamp = stamped.header.stamp
            fields = self._moving.fields(int(stamp.sec) * 10**9 + int(stamp.nanosec), T)
            if fields is None:
                continue
            cal.to_body(fields, self._T_child_body)
            try:
                found.append((SENSORS["odometry"].topic, build(SENSORS["odometry"].topic, fields)))
            except ValueError as error:
                self._refuse(topic, _first_line(error))
                continue
            self._words[topic] = "odometry"
            self.passed[topic] += 1
            self._describe()
        return found

    def _refuse(self, topic: str, reason: str) -> None:
        self.refused[topic] += 1
        self.fault = f"{topic}: {reason}"
        if self.rig is not None:
            self._describe()

    def _describe(self) -> None:
        counts = ", ".join(f"{topic} {self.passed[topic]}" for topic in sorted(self._words))
        refused = f"; {self.refused.total()} refused, last: {self.fault}" if self.refused else ""
        self.status = f"from ROS 2: {counts}{refused}"

    def _stamp_ns(self, message: Any, received_ns: int) -> int:
        stamp = message.header.stamp
        return int(stamp.sec) * 10**9 + int(stamp.nanosec) or received_ns


def _transforms(message: Any) -> Iterator[tuple[Any, np.ndarray]]:
    """The transforms of a TFMessage with their matrices; what is none is left out."""
    for stamped in message.transforms:
        try:
            T = transform_of(stamped.transform.translation, stamped.transform.rotation)
        except ValueError:
            continue
        if np.all(np.isfinite(T)):
            yield stamped, T


def _word_of(type_name: str) -> str:
    return next((word for word, sensor in SENSORS.items() if type_name in sensor.ros_types), "")


def _is_picture(message: Any) -> bool:
    """Raw image topics also carry depth maps and masks; their encoding tells."""
    fields = ros_fields("camera/image", message)
    return "width_px" in fields and fields["encoding"] in PICTURES


def _first_line(error: Exception) -> str:
    if hasattr(error, "errors"):
        fault = error.errors(include_url=False, include_input=False)[0]
        return f"{'.'.join(str(part) for part in fault['loc'])}: {fault['msg']}"
    return str(error).split("\n")[0][:200]
