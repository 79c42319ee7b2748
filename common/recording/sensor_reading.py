"""Reading of a robot's sensor messages, for bags and for a running ROS 2 robot: one place for both.

A message that is not as it should be is repaired where the repair is certain, else refused; both are counted
in an `InputReport`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from beamsplat.common import messages as m
from beamsplat.common.geometry.transforms import se3_to_se2
from beamsplat.common.recording import calibration as cal
from beamsplat.common.recording.image_reading import ImageReading
from beamsplat.common.recording.input_report import InputReport
from beamsplat.common.recording.ros_types import stamp_ns_of
from beamsplat.common.recording.sensors import SENSORS, build_message, ros_fields
from beamsplat.common.scans.clocks import clock_sentence
from beamsplat.common.scans.laser import laser_of_ros
from beamsplat.common.scans.reader import ScanReader


class SensorReading:
    """Converts ROS messages of the selected topics to messages of BeamSplat."""

    def __init__(
        self,
        report: InputReport,
        topics: dict[str, str],
        camera_info_topic: str = "",
        T_child_body: np.ndarray | None = None,
        scans: ScanReader | None = None,
        offsets_s: dict[str, float] | None = None,
    ) -> None:
        """Create a reader.

        Args:
            report: counts repairs and refusals.
            topics: ROS topic of each sensor ("image", "scan", "odometry", "pose").
            camera_info_topic: ROS topic of the images' CameraInfo, "" = none.
            T_child_body: [4, 4], from the child frame of the odometry to the body; None = identity.
            scans: reader of the scans; None = as the messages state.
            offsets_s: seconds to add to the stamps of sensors on another clock (common/scans/clocks.py).
        """
        self.report = report
        self.images = ImageReading(report, topics.get("image", ""), camera_info_topic)
        self._topics = topics
        self._T_child_body = np.eye(4) if T_child_body is None else T_child_body
        self.scans = scans or ScanReader(topics.get("scan", ""), report, as_stated=True)
        self._offsets_s = {} if offsets_s is None else offsets_s

    def read(self, sensor_name: str, ros_message: Any, received_ns: int) -> list[m.Message]:
        """Return the messages that one ROS message results in; none if it was refused.

        `received_ns`: time of reception, used as stamp for messages without a stamp.
        """
        sensor, topic = SENSORS[sensor_name], self._topics[sensor_name]
        try:
            if sensor_name == "scan":
                read = self.scans.read(laser_of_ros(ros_message, received_ns))
                return [build_message(sensor.topic, fields) for fields in read]
            if sensor_name == "image":
                fields = {"stamp_ns": stamp_ns_of(ros_message.header.stamp), **self.images.read(ros_message)}
            else:
                fields = ros_fields(sensor.topic, ros_message)
            if fields["stamp_ns"] == 0:
                fields["stamp_ns"] = received_ns
                self.report.repaired(topic, "stamp", 0, "no stamp: the receive time is used")
            elif offset_s := self._offsets_s.get(sensor_name, 0.0):
                what = f"{clock_sentence(topic, fields['stamp_ns'], offset_s)}: {offset_s:.3f} s is added"
                self.report.repaired(
                    topic, "header.stamp", f"{fields['stamp_ns'] / 1e9:.3f} s", what, "synchronise the clocks"
                )
                fields["stamp_ns"] += round(offset_s * 1e9)
            if sensor_name == "odometry":
                cal.move_odometry_to_body(fields, self._T_child_body)
                self.scans.add_odometry(fields["stamp_ns"], se3_to_se2(fields["T_odom_body"]))
            return [build_message(sensor.topic, fields)]
        except ValueError as error:
            self.report.refused(topic, error)
            return []
