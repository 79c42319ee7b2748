"""Source of sensor messages from a ROS bag."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.rig import RigFile, load_rig
from beamsplat.common.recording import calibration as cal
from beamsplat.common.recording.camera_info import CameraInfoIntrinsics, is_calibrated, read_camera_info
from beamsplat.common.recording.image_reading import describe_format, image_size_px, is_camera_image
from beamsplat.common.recording.input_report import InputReport
from beamsplat.common.recording.sensor_reading import SensorReading
from beamsplat.common.recording.sensors import SENSORS, ros_fields
from beamsplat.common.recording.static_frames import StaticFrames, normalize_frame
from beamsplat.common.recording.topic_choice import Candidate, choose_camera_info
from beamsplat.common.recording.transform_reading import TF_TYPES, TransformReading
from beamsplat.common.scans.reader import ScanReader
from beamsplat.services.replay.bags import Bag, BagTopic
from beamsplat.services.replay.decode import deserialize
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.scan_learning import learn_offsets, learn_scans
from beamsplat.services.replay.topic_selection import select_topics

_PEEK = 5  # messages that may fail to decode before the topic counts as broken


class BagSource:
    """Source of the selected topics of a bag, and of the calibration in the bag or in a rig file.

    Raises:
        UserError: a required topic is missing, or several topics are possible.
    """

    def __init__(self, bag: Bag, options: SourceOptions) -> None:
        self.bag = bag
        self.options = options
        self.where = str(bag.path)
        self.report = InputReport()  # of what was repaired and refused since `messages` was called
        self._info_topic = ""  # of the CameraInfo of the images
        self.chosen, self.choices, self._unused = select_topics(
            bag.topics, options, self.where, self._why_no_image
        )
        self._first = {sensor_name: self._peek(topic) for sensor_name, topic in self.chosen.items()}
        self.frames = StaticFrames()
        self.calibration = cal.Calibration()
        self._calibrated = False
        self._T_child_body = np.eye(4)
        self._transforms = TransformReading(InputReport())
        self._scans: ScanReader | None = None  # with the rules learnt from the bag
        self._played: ScanReader | None = None  # of the last `messages`
        self._offsets_s: dict[str, float] = {}
        self._delayed: list[str] = []  # sentences on receive delays
        self._tilt = ""

    @property
    def start_ns(self) -> int:
        return self.bag.start_ns

    @property
    def end_ns(self) -> int:
        return self.bag.end_ns

    @property
    def problems(self) -> list[str]:
        """Return sentences about the files, the calibration, and messages that were repaired or refused."""
        found = [
            *self.bag.problems,
            *self._unused,
            *self.calibration.doubts,
            *([self._tilt] if self._tilt else []),
        ]
        found += self._transforms.report.sentences
        found += self._delayed
        if self._played is not None:
            found += self._played.warnings
        return [*found, *self.report.sentences]

    def message_count(self) -> int:
        """Return the number of messages on the selected topics."""
        return sum(topic.count for topic in self.chosen.values())

    def rig(self) -> Any:
        """Return the calibration as the message `Rig`; for its origin see `rig_file`."""
        rig = self.rig_file()
        return rig.message(self.start_ns, rig.source)

    def rig_file(self) -> RigFile:
        """Return the calibration from the option `rig` if set, else from the bag.

        Raises:
            UserError: incomplete, or for another image size; the sentence lists all missing values.
        """
        self.calibrate()
        image = self.image_size_px()
        if self.options.rig is not None:
            rig = load_rig(self.options.rig)
            self._check_rig(rig, image)
            if rig.lidar is not None:
                self._tilt = cal.check_lidar_plane(rig.lidar.model().T_body_lidar, str(self.options.rig))
            return rig.model_copy(update={"source": rig.source or str(self.options.rig)})
        if "lidar" in self.calibration.mounts:
            frame = self._first["scan"].header.frame_id
            where = f"{self.where}: {self.chosen['scan'].name}: frame_id = {frame!r}"
            self._tilt = cal.check_lidar_plane(self.calibration.mounts["lidar"], where)
        if self.calibration.missing:
            missing = "; ".join(self.calibration.missing)
            raise UserError(
                f"{self.where}: calibration is missing: {missing}; give a rig file (`beamsplat rig` writes "
                'a first one) with rig = "rig.toml"'
            )
        return self.calibration.rig(self.where)

    def calibrate(self) -> cal.Calibration:
        """Return intrinsics and mounts from the bag, and fill `frames` with its static transforms."""
        if self._calibrated:
            return self.calibration
        self._calibrated = True
        sensor_frames = {
            sensor: normalize_frame(self._first[sensor_name].header.frame_id)
            for sensor, sensor_name in (("camera", "image"), ("lidar", "scan"))
            if sensor_name in self._first
        }
        odometry = self._first.get("odometry")
        child = normalize_frame(odometry.child_frame_id) if odometry is not None else ""
        beside = self._read_frames(static=True)
        if (
            any(self.frames.find(child or f, f) is None for f in sensor_frames.values())
            or not self.frames.names
        ):
            beside = self._read_frames(static=False)
        cal.find_mounts(
            self.calibration,
            self.frames,
            sensor_frames,
            child,
            self.options.body_frame,
            self.options.assume_mounts,
            beside,
        )
        if child and self.calibration.body_frame:
            T = self.frames.find(child, self.calibration.body_frame)
            self._T_child_body = np.eye(4) if T is None else T
        if "image" in self.chosen and self.options.rig is None:
            self._find_intrinsics()
        return self.calibration

    def messages(self, start_ns: int = 0, stop_ns: int | None = None) -> Iterator[tuple[int, str, Any]]:
        """Yield (receive time, topic, message) with start_ns <= receive time < stop_ns, by receive time."""
        self.calibrate()
        self.report.clear()
        scans = self.scan_reader()
        self._played = None if scans is None else scans.again(self.report)
        sensor_names = {topic.name: sensor_name for sensor_name, topic in self.chosen.items()}
        reading = SensorReading(
            self.report, {name: topic.name for name, topic in self.chosen.items()}, self._info_topic,
            self._T_child_body, self._played, self._offsets_s,
        )  # fmt: skip
        rig = load_rig(self.options.rig) if self.options.rig is not None else None
        if rig is not None and rig.camera is not None:
            reading.images.calibrate(rig.camera.model_dump(exclude={"mount"}), follow=False)
        elif self.calibration.camera is not None:
            reading.images.calibrate(self.calibration.camera, follow=True)
        names = [*sensor_names, *([self._info_topic] if self._info_topic else [])]
        for raw in self.bag.messages(names, start_ns, stop_ns):
            try:
                message = deserialize(raw)
            except ValueError as error:
                self.report.refused(raw.topic, error)
                continue
            if raw.topic == self._info_topic:
                reading.images.add_camera_info(message)
                continue
            sensor_name = sensor_names[raw.topic]
            for built in reading.read(sensor_name, message, raw.at_ns):
                yield raw.at_ns, SENSORS[sensor_name].topic, built

    def scan_reader(self) -> ScanReader | None:
        """Return a reader that has learnt how the scans of the bag are to be read; None if there are none."""
        self.calibrate()
        if "scan" in self.chosen and self._scans is None:
            self._offsets_s, self._delayed = learn_offsets(self.bag, self.chosen)
            rig = None if self.options.rig is None else load_rig(self.options.rig)
            lidar = None if rig is None else rig.lidar
            mount = self.calibration.mounts.get("lidar") if lidar is None else lidar.model().T_body_lidar
            section = None if lidar is None else lidar.scan
            self._scans = learn_scans(
                self.bag, self.chosen, section, mount, self._T_child_body, self._offsets_s
            )
        return self._scans

    def sample(self, sensor_name: str, count: int) -> list[dict[str, Any]]:
        """Return the fields of up to `count` messages of a sensor, evenly spread and not validated."""
        topic = self.chosen.get(sensor_name)
        found: list[dict[str, Any]] = []
        step = max(1, topic.count // count) if topic else 1
        for i, raw in enumerate(self.bag.messages([topic.name]) if topic else ()):
            if i % step == 0 and len(found) < count:
                with suppress(ValueError):  # counted in `messages`
                    found.append(ros_fields(SENSORS[sensor_name].topic, deserialize(raw)))
        return found

    def close(self) -> None:
        self.bag.close()

    def _peek(self, topic: BagTopic) -> Any:
        """Return the first message of a topic that can be decoded. Raises UserError if there is none."""
        for count, raw in enumerate(self.bag.messages([topic.name])):
            try:
                return deserialize(raw)
            except ValueError as error:
                if count >= _PEEK:
                    raise UserError(
                        f"{self.where}: {topic.name} has no message of type {topic.type_name}: {error}"
                    ) from error
        raise UserError(f"{self.where}: {topic.name} has no message that can be decoded")

    def _why_no_image(self, topic: BagTopic) -> str:
        """Return why a topic has no camera images, judged by its first message; "" if it has."""
        try:
            first = self._peek(topic)
        except UserError:
            return ""  # the error is reported when the topic is read
        if is_camera_image(first):
            return ""
        if hasattr(first, "format"):
            return f"format = {first.format!r}: {describe_format(bytes(first.data[:32]), str(first.format))}"
        return f"encoding = {first.encoding!r} is not that of a camera image"

    def image_size_px(self) -> tuple[int, int] | None:
        """Return (width, height) of the images; None if the bag has no images."""
        if "image" not in self._first:
            return None
        first = self._first["image"]
        size = image_size_px(first)
        if size is None:
            found = describe_format(bytes(first.data[:32]), str(first.format))
            raise UserError(
                f"{self.where}: {self.chosen['image'].name}: format = {first.format!r}: the image is "
                f"{found}; only JPEG and PNG are decoded: publish JPEG"
            )
        return size

    def _find_intrinsics(self) -> None:
        image = self.chosen["image"]
        by_name = {topic.name: topic for topic in self.bag.topics if topic.count}
        listed = [Candidate(topic.name, topic.type_name, topic.count) for topic in by_name.values()]
        name = choose_camera_info(listed, image.name, self.where, self.options.camera_info_topic)
        info = by_name[name] if name is not None else None
        if info is None:
            self.calibration.missing.append(
                f"there are images on {image.name} but no sensor_msgs/CameraInfo with the camera's K"
            )
            return
        size_px = self.image_size_px()
        assert size_px is not None  # there are images
        self._info_topic = info.name
        self.calibration.add_intrinsics(self._read_intrinsics(info, size_px, image.name), info.name)

    def _read_intrinsics(
        self, info: BagTopic, size_px: tuple[int, int], image_topic: str
    ) -> CameraInfoIntrinsics | None:
        """Return the intrinsics by the first CameraInfo that is calibrated and fits the size of the images.

        Raises:
            UserError: none fits; the text is that of the first one.
        """
        refusal: UserError | None = None
        for raw in self.bag.messages([info.name]):
            try:
                message = deserialize(raw)
            except ValueError:  # counted in `messages`
                continue
            if not is_calibrated(message):
                continue
            try:
                return read_camera_info(message, size_px, image_topic, self.where)
            except UserError as error:
                refusal = refusal or error
        if refusal is not None:
            raise refusal
        return None

    def _read_frames(self, *, static: bool) -> str:
        """Fill `frames` with the transforms of tf_static, or also those of tf, beside the sensors.

        Returns why there are none, or "".
        """
        names = [
            topic.name
            for topic in self.bag.topics
            if topic.type_name in TF_TYPES and topic.name.endswith("tf_static") == static
        ]
        for raw in self.bag.messages(names) if names else ():
            try:
                message = deserialize(raw)
            except ValueError as error:
                self._transforms.report.refused(raw.topic, error)
                continue
            self._transforms.add(raw.topic, message)
        sensor = self.chosen.get("scan") or self.chosen.get("image")
        if sensor is None:
            return ""
        self.frames, beside = self._transforms.tree(sensor.name, constant=not static)
        return beside

    def _check_rig(self, rig: RigFile, image: tuple[int, int] | None) -> None:
        for sensor_name, sensor in (("image", "camera"), ("scan", "lidar")):
            if sensor_name in self.chosen and getattr(rig, sensor) is None:
                raise UserError(
                    f"{self.options.rig}: has no [{sensor}], but there is {self.chosen[sensor_name].name} in "
                    f"{self.where}; "
                    f'add it, or set without = ["{sensor_name}"]'
                )
        if rig.camera and image and (rig.camera.width_px, rig.camera.height_px) != image:
            raise UserError(
                f"{self.options.rig}: K is for {rig.camera.width_px}x{rig.camera.height_px} px but the "
                f"images of {self.where} are {image[0]}x{image[1]} px; calibrate at this size"
            )
