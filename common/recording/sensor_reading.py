"""Reading of a robot's sensor messages, for bags and for a running ROS 2 robot: one place for both.

A message that is not as it should be is repaired where the repair is certain, else refused; both are counted
in an `InputReport`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from beamsplat.common import messages as m
from beamsplat.common.recording import calibration as cal
from beamsplat.common.recording.image_reading import ImageReading
from beamsplat.common.recording.input_report import InputReport
from beamsplat.common.recording.ros_types import stamp_ns_of
from beamsplat.common.recording.sensors import SENSORS, build_message, ros_fields


class SensorReading:
    """Converts ROS messages of the selected topics to messages of BeamSplat."""

    def __init__(
        self,
        report: InputReport,
        topics: dict[str, str],
        camera_info_topic: str = "",
        T_child_body: np.ndarray | None = None,
    ) -> None:
        """Create a reader.

        Args:
            report: counts repairs and refusals.
            topics: ROS topic of each sensor ("image", "scan", "odometry", "pose").
            camera_info_topic: ROS topic of the images' CameraInfo, "" = none.
            T_child_body: [4, 4], from the child frame of the odometry to the body; None = identity.
        """
        self.report = report
        self.images = ImageReading(report, topics.get("image", ""), camera_info_topic)
        self._topics = topics
        self._T_child_body = np.eye(4) if T_child_body is None else T_child_body

    def read(self, sensor_name: str, ros_message: Any, received_ns: int) -> list[m.Message]:
        """Return the messages that one ROS message results in; none if it was refused.

        `received_ns`: time of reception, used as stamp for messages without a stamp.
        """
        sensor, topic = SENSORS[sensor_name], self._topics[sensor_name]
        try:
            if sensor_name == "image":
                fields = {"stamp_ns": stamp_ns_of(ros_message.header.stamp), **self.images.read(ros_message)}
            else:
                fields = ros_fields(sensor.topic, ros_message)
            if fields["stamp_ns"] == 0:
                fields["stamp_ns"] = received_ns
                self.report.repaired(topic, "stamp", 0, "no stamp: the receive time is used")
            if sensor_name == "odometry":
                cal.move_odometry_to_body(fields, self._T_child_body)
            return [build_message(sensor.topic, fields)]
        except ValueError as error:
            self.report.refused(topic, error)
            return []
