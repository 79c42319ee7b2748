"""Source of sensor messages from a ROS bag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.rig import RigFile, load_rig
from beamsplat.common.recording import calibration as cal
from beamsplat.common.recording.ros_types import transform_of
from beamsplat.common.recording.sensors import SENSORS, build_message, ros_fields
from beamsplat.common.recording.static_frames import StaticFrames, normalize_frame
from beamsplat.services.replay.bags import Bag, BagTopic
from beamsplat.services.replay.decode import RawMessage, deserialize
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.topic_selection import choose_camera_info, choose_topics

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_IMAGE_ENCODINGS = ("rgb8", "bgr8", "rgba8", "bgra8", "mono8", "yuv422_yuy2", "jpeg", "png")
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
        self.skipped: Counter[str] = Counter()  # messages that cannot be decoded or are invalid, by topic
        self.unstamped: Counter[str] = Counter()  # messages with stamp 0, by topic
        self.first_fault: dict[str, str] = {}
        self.chosen = choose_topics(bag.topics, options, self.where, self._is_image)
        self._first = {sensor_name: self._peek(topic) for sensor_name, topic in self.chosen.items()}
        self.frames = StaticFrames()
        self.calibration = cal.Calibration()
        self._calibrated = False
        self._T_child_body = np.eye(4)

    @property
    def start_ns(self) -> int:
        return self.bag.start_ns

    @property
    def end_ns(self) -> int:
        return self.bag.end_ns

    @property
    def problems(self) -> list[str]:
        """Return sentences about messages that were skipped and stamps that were replaced."""
        found = list(self.bag.problems)
        for name, count in sorted(self.skipped.items()):
            found.append(f"{name}: {count} messages skipped, the first because: {self.first_fault[name]}")
        found += [
            f"{name}: {count} messages have no stamp; the receive time is used"
            for name, count in sorted(self.unstamped.items())
        ]
        return found

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
            return rig.model_copy(update={"source": rig.source or str(self.options.rig)})
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
        self._read_frames(static=True)
        if (
            any(self.frames.find(child or f, f) is None for f in sensor_frames.values())
            or not self.frames.names
        ):
            self._read_frames(static=False)
        cal.find_mounts(
            self.calibration,
            self.frames,
            sensor_frames,
            child,
            self.options.body_frame,
            self.options.assume_mounts,
        )
        if child and self.calibration.body_frame:
            T = self.frames.find(child, self.calibration.body_frame)
            self._T_child_body = np.eye(4) if T is None else T
        if "image" in self.chosen and self.options.rig is None:
            self._find_intrinsics()
        return self.calibration

    def messages(self, start_ns: int = 0, stop_ns: int | None = None) -> Iterator[tuple[int, str, Any]]:
        """Yield (receive time, topic, message) with start_ns <= receive time < stop_ns, by receive time."""
        sensor_names = {topic.name: sensor_name for sensor_name, topic in self.chosen.items()}
        for raw in self.bag.messages(list(sensor_names), start_ns, stop_ns):
            sensor = SENSORS[sensor_names[raw.topic]]
            try:
                fields = ros_fields(sensor.topic, deserialize(raw))
                if fields["stamp_ns"] == 0:
                    fields["stamp_ns"] = raw.at_ns
                    self.unstamped[raw.topic] += 1
                if sensor.name == "odometry":
                    cal.move_odometry_to_body(fields, self._T_child_body)
                message = build_message(sensor.topic, fields)
            except ValueError as error:
                self.skipped[raw.topic] += 1
                self.first_fault.setdefault(raw.topic, _reason_of(error))
                continue
            yield raw.at_ns, sensor.topic, message

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

    def _is_image(self, topic: BagTopic) -> bool:
        """Return whether a topic has camera images; raw image topics may also have depth maps and masks."""
        try:
            fields = ros_fields("camera/image", self._peek(topic))
        except UserError:
            return True  # the error is reported when the topic is read
        if topic.type_name == "sensor_msgs/msg/CompressedImage":
            return "width_px" in fields
        return fields["encoding"] in _IMAGE_ENCODINGS

    def image_size_px(self) -> tuple[int, int] | None:
        """Return (width, height) of the images; None if the bag has no images."""
        if "image" not in self._first:
            return None
        fields = ros_fields("camera/image", self._first["image"])
        if "width_px" not in fields:
            name = self.chosen["image"].name
            raise UserError(f"{self.where}: {name} starts with an image that is neither JPEG nor PNG")
        return fields["width_px"], fields["height_px"]

    def _find_intrinsics(self) -> None:
        image = self.chosen["image"]
        info = choose_camera_info(self.bag.topics, image, self.options.camera_info_topic, self.where)
        if info is None:
            self.calibration.missing.append(
                f"there are images on {image.name} but no sensor_msgs/CameraInfo with the camera's K"
            )
            return
        size_px = self.image_size_px()
        assert size_px is not None  # there are images
        self.calibration.camera = cal.intrinsics(self._peek(info), size_px, image.name, self.where)
        if self.calibration.camera is None:
            self.calibration.missing.append(f"K on {info.name} is all zero: this camera was never calibrated")
        else:
            K = self.calibration.camera
            self.calibration.found.append(
                f"K from {info.name}: fx {K['fx_px']:.1f}, fy {K['fy_px']:.1f}, cx {K['cx_px']:.1f}, "
                f"cy {K['cy_px']:.1f} px for {K['width_px']}x{K['height_px']}, "
                f"distortion {K['distortion_model']}"
            )

    def _read_frames(self, *, static: bool) -> None:
        """Add the transforms of /tf_static, or those of /tf, to `frames`."""
        names = [
            topic.name
            for topic in self.bag.topics
            if topic.type_name in TF_TYPES and topic.name.endswith("tf_static") == static
        ]
        if not names:
            return
        for raw in self.bag.messages(names):
            for parent, child, T in _transforms(raw):
                self.frames.add(parent, child, T, replace=static)

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


def _transforms(raw: RawMessage) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield (parent, child, T_parent_child) of a TFMessage; invalid ones are skipped."""
    try:
        message = deserialize(raw)
        for stamped in message.transforms:
            T = transform_of(stamped.transform.translation, stamped.transform.rotation)
            if np.all(np.isfinite(T)):
                yield stamped.header.frame_id, stamped.child_frame_id, T
    except ValueError:
        return


def _reason_of(error: Exception) -> str:
    """Return field and reason of a validation error, in one line."""
    if hasattr(error, "errors"):
        fault = error.errors(include_url=False, include_input=False)[0]
        return f"{'.'.join(str(part) for part in fault['loc'])}: {fault['msg']}"
    return str(error).split("\n")[0][:200]
