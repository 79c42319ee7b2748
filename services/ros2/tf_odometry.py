"""Wheel odometry from /tf, for robots that publish odom -> base_link (REP 105) but no Odometry topic."""

from __future__ import annotations

from typing import Any

import numpy as np

from beamsplat.common.geometry.transforms import inverse, se3_log
from beamsplat.common.recording.static_frames import BODY_NAMES, normalize_frame

_ODOM = "odom"
_MAX_STEP_NS = 1_000_000_000  # over a longer interval the velocity is unknown


class TfOdometry:
    """Finds the transform odom -> base in /tf and computes velocities from its changes."""

    def __init__(self) -> None:
        self._edges: set[tuple[str, str]] = set()  # the first two (odom, child) on /tf
        self._previous: tuple[int, np.ndarray] | None = None

    def add_edge(self, parent: str, child: str) -> None:
        """Register the frames (parent, child) of a transform on /tf, if they have the usual names."""
        edge = normalize_frame(parent), normalize_frame(child)
        usual = edge[0].split("/")[-1] == _ODOM and edge[1].split("/")[-1] in BODY_NAMES
        if usual and len(self._edges) < 2:  # of two or more, none can be chosen
            self._edges.add(edge)

    def odometry_edge(self) -> tuple[str, str] | None:
        """Return the frames (odom, child), found by their usual names; None unless exactly one matches."""
        return next(iter(self._edges)) if len(self._edges) == 1 else None

    def odometry_fields(self, stamp_ns: int, T_odom_child: np.ndarray) -> dict[str, Any] | None:
        """Return the fields of a `WheelOdometry` message for the transform `T_odom_child` [4, 4].

        Returns None for the first transform, whose velocity is unknown, and for a stamp not newer than the
        last.
        """
        previous = self._previous
        if previous is not None and 0 <= previous[0] - stamp_ns < _MAX_STEP_NS:
            return None  # repeated by several nodes
        self._previous = stamp_ns, T_odom_child
        if previous is None or not 0 < stamp_ns - previous[0] <= _MAX_STEP_NS:
            return None
        step = se3_log(inverse(previous[1]) @ T_odom_child) / ((stamp_ns - previous[0]) / 1e9)
        return {
            "stamp_ns": stamp_ns, "T_odom_body": T_odom_child, "velocity_m_s": step[:3],
            "angular_velocity_rad_s": step[3:],
        }  # fmt: skip
