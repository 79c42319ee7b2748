"""Poses of a robot that stands still: fewer of them cross the link to the edge server."""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.transforms import inverse, se3_log
from beamsplat.common.messages import Odometry

_MOVED_M, _TURNED_RAD = 0.01, 0.01  # above the noise of the pose at rest, below what a viewer of the map sees
_PERIOD_NS = 1_000_000_000  # at rest, one pose in this time crosses the link: viewers see that it is alive


class PoseThinning:
    """Decides which poses are forwarded: those that differ from the last one, and one per second at rest."""

    def __init__(self) -> None:
        self._last: Odometry | None = None  # forwarded

    def is_due(self, odometry: Odometry) -> bool:
        """Return whether a pose must be forwarded, and take it as forwarded in that case."""
        due = self._last is None or self._differs(self._last, odometry)
        if due:
            self._last = odometry
        return due

    @staticmethod
    def _differs(last: Odometry, odometry: Odometry) -> bool:
        if (last.status, last.metric) != (odometry.status, odometry.metric):
            return True
        if not 0 <= odometry.stamp_ns - last.stamp_ns < _PERIOD_NS:
            return True
        moved = np.abs(se3_log(inverse(last.T_odom_body) @ odometry.T_odom_body))
        return bool((moved[:3] > _MOVED_M).any() or (moved[3:] > _TURNED_RAD).any())
