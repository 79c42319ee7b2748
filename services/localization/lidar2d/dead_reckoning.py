"""Along a corridor the scans say nothing; there the wheels count the way, from the last scan that knew."""

from __future__ import annotations

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.odometry import OdometryBuffer

SEEN = 0.7  # trust along the weak direction above which a scan knows where it is
GAIN = 0.5  # stamps of wheels and scans jitter: the pose follows the count, it does not copy it
CHECK_M = 1.0  # the wheels are checked against the scans over stretches of this length
USABLE = 0.15  # and are used while they are wrong by less than this share of the way
BLIND_M = 1.0  # after such a way the scans are no longer held to what they were before, see regained()
SIGMA_M = 0.15  # what the count is worth in an edge of the pose graph


class DeadReckoning:
    """Counts increments between scans, so that jitter of single stamps does not add up."""

    def __init__(self, odometry: OdometryBuffer) -> None:
        self._odometry = odometry
        self._counted: np.ndarray | None = None  # T_odom_body whose part along the corridor is the wheels'
        self._stamp_ns = 0
        self._check: tuple[int, np.ndarray] | None = None
        self.error_share = 0.0
        self.lost_sight = False
        self._blind_m = 0.0
        self._last: np.ndarray | None = None

    def regained(self) -> bool:
        """True once, when the scans know again where they are after a long way of counting."""
        if self.lost_sight or self._blind_m < BLIND_M:
            return False
        self._blind_m = 0.0
        return True

    def predict(self, stamp_ns: int) -> np.ndarray | None:
        """T_odom_body by count, while the scans do not know; None if they do or the wheels are no good."""
        if not self.lost_sight:
            return None
        return self._carried(stamp_ns)

    def _carried(self, stamp_ns: int) -> np.ndarray | None:
        if self._counted is None or self.error_share > USABLE:
            return None
        moved = self._odometry.increment(self._stamp_ns, stamp_ns)
        return None if moved is None else se2.compose(self._counted, moved)

    def correct(
        self, stamp_ns: int, T_odom_body: np.ndarray, trust: float, direction_odom: np.ndarray
    ) -> tuple[np.ndarray, bool]:
        """The pose with its part along the weak direction drawn to the count; whether that was done."""
        carried = self._carried(stamp_ns)
        was_lost, self.lost_sight = self.lost_sight, trust < SEEN
        if was_lost and self._last is not None:
            self._blind_m += float(np.hypot(*(T_odom_body - self._last)[:2]))
        elif self.lost_sight:
            self._blind_m = 0.0
        self._last = T_odom_body
        self._stamp_ns = stamp_ns
        if not self.lost_sight:
            self._counted = T_odom_body
            self._learn(stamp_ns, T_odom_body)
            return T_odom_body, False
        self._check = None
        if carried is None:
            self._counted = None
            return T_odom_body, False
        off = (1.0 - trust**2) * float((carried - T_odom_body)[:2] @ direction_odom)
        self._counted, corrected = T_odom_body.copy(), T_odom_body.copy()
        self._counted[:2] += off * direction_odom
        corrected[:2] += GAIN * off * direction_odom
        return corrected, True

    def restart(self, stamp_ns: int, T_odom_body: np.ndarray) -> None:
        """Begin again from a pose (first scan, loss of track)."""
        self._counted, self._stamp_ns, self._check, self.lost_sight = T_odom_body, stamp_ns, None, False

    def _learn(self, stamp_ns: int, T_odom_body: np.ndarray) -> None:
        if self._check is None:
            self._check = (stamp_ns, T_odom_body)
            return
        matched = se2.between(self._check[1], T_odom_body)
        way = float(np.hypot(matched[0], matched[1]))
        if way < CHECK_M:
            return
        wheels = self._odometry.increment(self._check[0], stamp_ns)
        self._check = (stamp_ns, T_odom_body)
        if wheels is not None:
            # Lengths only: the heading comes from the scans.
            share = abs(float(np.hypot(wheels[0], wheels[1])) - way) / way
            self.error_share += 0.2 * (min(share, 1.0) - self.error_share)
