"""Along a corridor the scans say nothing; there the wheels count the way, from the last scan that knew."""

from __future__ import annotations

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.odometry import OdometryBuffer

MIN_TRUST = 0.7  # trust along the weak direction above which a scan knows where it is
CORRECTION_GAIN = 0.5  # stamps of wheels and scans jitter: the pose follows the count, it does not copy it
CHECK_DISTANCE_M = 1.0  # the wheels are checked against the scans over stretches of this length
MAX_ERROR_RATIO = 0.15  # and are used while they are wrong by less than this share of the way
DEGENERATE_DISTANCE_M = (
    1.0  # after such a way the scans are no longer held to what they were before, see take_recovery()
)
WHEEL_SIGMA_M = 0.15  # what the count is worth in an edge of the pose graph


class DeadReckoning:
    """Counts increments between scans, so that jitter of single stamps does not add up."""

    def __init__(self, odometry: OdometryBuffer) -> None:
        self._odometry = odometry
        self._reckoned_pose: np.ndarray | None = (
            None  # pose_odom_body whose part along the corridor is the wheels'
        )
        self._stamp_ns = 0
        self._check: tuple[int, np.ndarray] | None = None
        self.error_ratio = 0.0
        self.degenerate = False
        self._degenerate_m = 0.0
        self._last_pose: np.ndarray | None = None

    def take_recovery(self) -> bool:
        """True once, when the scans know again where they are after a long way of counting."""
        if self.degenerate or self._degenerate_m < DEGENERATE_DISTANCE_M:
            return False
        self._degenerate_m = 0.0
        return True

    def predict(self, stamp_ns: int) -> np.ndarray | None:
        """T_odom_body by count, while the scans do not know; None if they do or the wheels are no good."""
        if not self.degenerate:
            return None
        return self._extrapolated(stamp_ns)

    def _extrapolated(self, stamp_ns: int) -> np.ndarray | None:
        if self._reckoned_pose is None or self.error_ratio > MAX_ERROR_RATIO:
            return None
        moved = self._odometry.increment(self._stamp_ns, stamp_ns)
        return None if moved is None else se2.compose(self._reckoned_pose, moved)

    def correct(
        self, stamp_ns: int, pose_odom_body: np.ndarray, trust: float, direction_odom: np.ndarray
    ) -> tuple[np.ndarray, bool]:
        """The pose with its part along the weak direction drawn to the count; whether that was done."""
        extrapolated = self._extrapolated(stamp_ns)
        was_lost, self.degenerate = self.degenerate, trust < MIN_TRUST
        if was_lost and self._last_pose is not None:
            self._degenerate_m += float(np.hypot(*(pose_odom_body - self._last_pose)[:2]))
        elif self.degenerate:
            self._degenerate_m = 0.0
        self._last_pose = pose_odom_body
        self._stamp_ns = stamp_ns
        if not self.degenerate:
            self._reckoned_pose = pose_odom_body
            self._update_error_ratio(stamp_ns, pose_odom_body)
            return pose_odom_body, False
        self._check = None
        if extrapolated is None:
            self._reckoned_pose = None
            return pose_odom_body, False
        off = (1.0 - trust**2) * float((extrapolated - pose_odom_body)[:2] @ direction_odom)
        self._reckoned_pose, corrected = pose_odom_body.copy(), pose_odom_body.copy()
        self._reckoned_pose[:2] += off * direction_odom
        corrected[:2] += CORRECTION_GAIN * off * direction_odom
        return corrected, True

    def restart(self, stamp_ns: int, pose_odom_body: np.ndarray) -> None:
        """Begin again from a pose (first scan, loss of track)."""
        self._reckoned_pose, self._stamp_ns, self._check, self.degenerate = (
            pose_odom_body,
            stamp_ns,
            None,
            False,
        )

    def _update_error_ratio(self, stamp_ns: int, pose_odom_body: np.ndarray) -> None:
        if self._check is None:
            self._check = (stamp_ns, pose_odom_body)
            return
        matched = se2.between(self._check[1], pose_odom_body)
        way = float(np.hypot(matched[0], matched[1]))
        if way < CHECK_DISTANCE_M:
            return
        wheels = self._odometry.increment(self._check[0], stamp_ns)
        self._check = (stamp_ns, pose_odom_body)
        if wheels is not None:
            # Lengths only: the heading comes from the scans.
            share = abs(float(np.hypot(wheels[0], wheels[1])) - way) / way
            self.error_ratio += 0.2 * (min(share, 1.0) - self.error_ratio)
