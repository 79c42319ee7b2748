"""Wheel odometry out of /tf: a robot that publishes odom -> base and no Odometry has it there (REP 105)."""

from __future__ import annotations

from typing import Any

import numpy as np

from beamsplat.common.geometry.transforms import inverse, se3_log
from beamsplat.common.recording.static_frames import BODY_NAMES, clean

_ODOM = "odom"
_LONGEST_NS = 1_000_000_000  # a pause longer than that tells no velocity


class MovingFrames:
    """The transform from the odometry's frame to the robot's, as it comes."""

    def __init__(self) -> None:
        self._edges: set[tuple[str, str]] = set()  # (parent, child) said on /tf
        self._before: tuple[int, np.ndarray] | None = None

    def note(self, parent: str, child: str) -> None:
        """Somebody says on /tf where `child` is in `parent`."""
        self._edges.add((clean(parent), clean(child)))

    def edge(self) -> tuple[str, str] | None:
        """(odom, child) by their customary names, standing still or not; None where nobody says it."""
        found = [
            (parent, child)
            for parent, child in sorted(self._edges)
            if parent.split("/")[-1] == _ODOM and child.split("/")[-1] in BODY_NAMES
        ]
        return found[0] if len(found) == 1 else None

    def fields(self, stamp_ns: int, T_odom_child: np.ndarray) -> dict[str, Any] | None:
        """The fields of a WheelOdometry of the child; None for what is no later than the one before, and for
        the first, whose velocity nobody knows."""
        before = self._before
        if before is not None and 0 <= before[0] - stamp_ns < _LONGEST_NS:
            return None  # several nodes repeat it
        self._before = stamp_ns, T_odom_child
        if before is None or not 0 < stamp_ns - before[0] <= _LONGEST_NS:
            return None
        step = se3_log(inverse(before[1]) @ T_odom_child) / ((stamp_ns - before[0]) / 1e9)
        return {
            "stamp_ns": stamp_ns, "T_odom_body": T_odom_child, "velocity_m_s": step[:3],
            "angular_velocity_rad_s": step[3:],
        }  # fmt: skip
