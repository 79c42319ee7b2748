"""Dead reckoning along the direction that scan matching cannot observe, for example along a corridor."""

from __future__ import annotations

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.odometry import OdometryBuffer

MIN_TRUST = 0.7  # observability of the weak direction, below which a match is degenerate
# Fraction of the difference applied per scan; below 1, because the stamps of wheels and scans jitter.
CORRECTION_GAIN = 0.5
CHECK_DISTANCE_M = 1.0  # distance over which the odometry is compared with the scans
MAX_ERROR_RATIO = 0.15  # relative distance error, above which the odometry is not used
DEGENERATE_DISTANCE_M = 1.0  # after a longer degenerate stretch, a new submap is started; see take_recovery()
WHEEL_SIGMA_M = 0.15  # standard deviation of the reckoned position in a pose graph constraint


class DeadReckoning:
    """Integrates wheel odometry between scans while the scan matching is degenerate.

    It starts at the last scan with an observable pose. Increments are summed over the whole stretch, so that
    stamp jitter does not accumulate.
    """

    def __init__(self, odometry: OdometryBuffer) -> None:
        self._odometry = odometry
        self._reckoned_pose: np.ndarray | None = None  # pose_odom_body; wheels along the weak direction
        self._stamp_ns = 0
        self._check: tuple[int, np.ndarray] | None = None
        self.error_ratio = 0.0
        self.degenerate = False
        self._degenerate_m = 0.0
        self._last_pose: np.ndarray | None = None

    def take_recovery(self) -> bool:
        """Return True once when the pose becomes observable again after a long degenerate stretch.

        The caller then starts a new submap.
        """
        if self.degenerate or self._degenerate_m < DEGENERATE_DISTANCE_M:
            return False
        self._degenerate_m = 0.0
        return True

    def predict(self, stamp_ns: int) -> np.ndarray | None:
        """Return pose_odom_body [3] by dead reckoning while the matching is degenerate.

        Returns None if the pose is observable, or if the odometry is missing or inaccurate.
        """
        if not self.degenerate:
            return None
        return self._extrapolated(stamp_ns)

    def _extrapolated(self, stamp_ns: int) -> np.ndarray | None:
        """Return pose_odom_body [3] by wheel odometry, None if the odometry is missing or inaccurate."""
        if self._reckoned_pose is None or self.error_ratio > MAX_ERROR_RATIO:
            return None
        moved = self._odometry.increment(self._stamp_ns, stamp_ns)
        return None if moved is None else se2.compose(self._reckoned_pose, moved)

    def correct(
        self, stamp_ns: int, pose_odom_body: np.ndarray, trust: float, direction_odom: np.ndarray
    ) -> tuple[np.ndarray, bool]:
        """Correct a matched pose along its weak direction by dead reckoning.

        Args:
            pose_odom_body: float64 [3], the matched pose.
            trust: observability along the weak direction, 0 .. 1, see observability.ObservedMatch.
            direction_odom: float64 [2], unit vector of the weak direction in the odom frame.

        Returns:
            pose_odom_body [3], and whether it was corrected.
        """
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
        """Start again from a matched pose: after the first scan, or after a loss of tracking."""
        self._reckoned_pose, self._stamp_ns, self._check, self.degenerate = (
            pose_odom_body,
            stamp_ns,
            None,
            False,
        )

    def _update_error_ratio(self, stamp_ns: int, pose_odom_body: np.ndarray) -> None:
        """Update `error_ratio`: relative error of the distance by wheels against the distance by scans."""
        if self._check is None:
            self._check = (stamp_ns, pose_odom_body)
            return
        matched = se2.between(self._check[1], pose_odom_body)
        distance = float(np.hypot(matched[0], matched[1]))
        if distance < CHECK_DISTANCE_M:
            return
        wheels = self._odometry.increment(self._check[0], stamp_ns)
        self._check = (stamp_ns, pose_odom_body)
        if wheels is not None:
            # Compare distances only, because the heading comes from the scans.
            ratio = abs(float(np.hypot(wheels[0], wheels[1])) - distance) / distance
            self.error_ratio += 0.2 * (min(ratio, 1.0) - self.error_ratio)
