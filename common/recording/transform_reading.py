"""Reading of transforms from all tf topics of a recording or robot, each namespace by itself.

Several robots that record together publish /robot1/tf_static, /robot2/tf_static, ... with the same names of
frames (the convention of nav2 and of Create 3). The transforms beside the chosen sensor are used.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from beamsplat.common.recording.input_report import InputFault, InputReport
from beamsplat.common.recording.ros_types import transform_of
from beamsplat.common.recording.static_frames import StaticFrames

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_UNIT = 0.01  # a quaternion whose length differs more from 1 is reported
_MAX_NAMESPACES = 32
_LIMIT_M = 1000.0  # of a mount; more is an error of the publisher


class TransformReading:
    """The static transforms of each namespace; `report` counts what was repaired and refused."""

    def __init__(self, report: InputReport) -> None:
        self.report = report
        self._fixed: dict[str, StaticFrames] = {}  # namespace -> transforms of tf_static
        self._constant: dict[str, StaticFrames] = {}  # also those of tf, as long as they do not change

    @property
    def ignored(self) -> int:
        """Return the number of transforms that were ignored because there were too many frames."""
        return sum(tree.ignored for tree in self._constant.values())

    def add(self, topic: str, message: Any) -> list[tuple[Any, np.ndarray]]:
        """Add the transforms of a TFMessage; return each valid one with its matrix [4, 4]."""
        space = namespace_of(topic)
        if space not in self._constant and len(self._constant) >= _MAX_NAMESPACES:
            self.report.refused(
                topic, InputFault("", "", f"more than {_MAX_NAMESPACES} namespaces of transforms")
            )
            return []
        fixed = topic.endswith("tf_static")
        trees = [self._constant.setdefault(space, StaticFrames())]
        if fixed:
            trees.append(self._fixed.setdefault(space, StaticFrames()))
        valid = list(valid_transforms(topic, message, self.report))
        for stamped, T in valid:
            for tree in trees:
                tree.add(stamped.header.frame_id, stamped.child_frame_id, T, replace=fixed)
        return valid

    def tree(self, sensor_topic: str, *, constant: bool) -> tuple[StaticFrames, str]:
        """Return the transforms that belong to the sensor on `sensor_topic`, and why there are none, or "".

        Args:
            sensor_topic: ROS topic of the sensor.
            constant: also transforms of /tf that have not changed so far.
        """
        trees = self._constant if constant else self._fixed
        sensor_topic = "/" + sensor_topic.strip("/")
        above = [space for space in trees if sensor_topic.startswith(space + "/")]
        if above:
            return StaticFrames.merged([trees[space] for space in sorted(above, key=len)]), ""
        if len(trees) == 1:
            return next(iter(trees.values())), ""
        if not trees:
            return StaticFrames(), ""
        names = ", ".join(f"{space or '/'}" for space in sorted(trees))
        return (
            StaticFrames(),
            f"there are transforms in {names}, none of them in the namespace of {sensor_topic}",
        )


def namespace_of(topic: str) -> str:
    """Return the namespace of a topic with a leading slash; "" for a topic without namespace."""
    return ("/" + topic.strip("/")).rsplit("/", 1)[0]


def valid_transforms(topic: str, message: Any, report: InputReport) -> Iterator[tuple[Any, np.ndarray]]:
    """Yield each transform of a TFMessage with its matrix [4, 4]; count the others in `report`."""
    for stamped in message.transforms:
        q, p = stamped.transform.rotation, stamped.transform.translation
        name = f"transform {stamped.header.frame_id!s:.60} -> {stamped.child_frame_id!s:.60}"
        quat = f"[{q.x:g} {q.y:g} {q.z:g} {q.w:g}]"
        remedy = "correct its publisher"
        try:
            T = transform_of(p, q)
        except ValueError:
            fault = InputFault(
                f"{name}: rotation", quat, "not a rotation: this transform is left out", remedy
            )
            report.refused(topic, fault)
            continue
        if not np.all(np.isfinite(T)) or float(np.abs(T[:3, 3]).max()) > 1e9:
            value = f"[{p.x:g} {p.y:g} {p.z:g}]"
            fault = InputFault(f"{name}: translation", value, "not a position: it is left out", remedy)
            report.refused(topic, fault)
            continue
        length = float(np.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w))
        if abs(length - 1.0) > _UNIT:
            report.repaired(
                topic, f"{name}: rotation", quat, f"its length is {length:.3g}: it was normalised", remedy
            )
        yield stamped, T
