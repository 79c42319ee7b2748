"""Prediction of the body's motion from the last scan to the next, by wheels, velocity and standstill."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.dead_reckoning import WHEEL_SIGMA_M, DeadReckoning
from beamsplat.services.localization.lidar2d.odometry import MotionErrorModel, OdometryBuffer
from beamsplat.services.localization.lidar2d.scan import RawScan, duration_s
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.twist import TwistErrorModel, exp_twist, twist
from beamsplat.services.localization.lidar2d.wheel_gap import POSITION_SIGMA_M

NS = 1e-9


@dataclass(frozen=True)
class Prediction:
    """Predicted motion of the body since the last scan, with standard deviations."""

    motion: np.ndarray  # float64 [3], pose_last_now
    sigma_m: float
    sigma_rad: float
    source: str
    long_gap: bool  # no scan was matched for over 1 s, and no continuous wheel odometry covers the gap


class MotionPredictor:
    """Poses of the recent scans, the wheel odometry, and the errors of the predictions by each source."""

    def __init__(self, settings: LidarSlamSettings) -> None:
        self.settings = settings
        self.odometry = OdometryBuffer()
        self.reckoning = DeadReckoning(self.odometry)
        self._wheel_error = MotionErrorModel(0.01, 0.05, 0.02, 0.004, 0.05, 0.03)
        self._velocity_error = MotionErrorModel(0.02, 0.10, 0.3, 0.02, 0.20, 0.4)
        self._standstill_error = MotionErrorModel(0.05, 0.0, 0.3, 0.05, 0.0, 0.4)
        self.twist_error = TwistErrorModel()
        self._predicted_twist: np.ndarray | None = None  # float64 [3], for the interval after the last pose
        self.stamps: list[int] = []  # recent stamps and poses, newest last
        self.poses: list[np.ndarray] = []
        self.last_matched: tuple[int, np.ndarray] = (0, np.zeros(3))  # stamp and pose of the last good match
        # The last good match before the clock was set back, while the motion over that is not known.
        self._set_back: tuple[int, np.ndarray] | None = None

    def restart_clock(self, stamp_ns: int) -> None:
        """Continue at the stamp `stamp_ns`, after the clock was set back: from where the wheels say, else
        from the last pose, until the wheels or a match say more."""
        if not self.poses:
            return
        before = self._set_back or self.last_matched
        self.odometry.clock_set_back(self.stamps[-1], stamp_ns)
        moved = self.odometry.motion_over_set_back(before[0], stamp_ns)
        pose = self.poses[-1] if moved is None else se2.compose(before[1], moved)
        self._set_back = before if moved is None else None
        self.stamps, self.poses = [stamp_ns - round(0.1 / NS)], [pose]
        self.last_matched = self.stamps[-1], before[1] if moved is None else pose
        self.reckoning.restart(stamp_ns, pose)

    def start_segment(self, stamp_ns: int, pose_odom_body: np.ndarray) -> bool:
        """Continue from a pose that begins a new segment of the trajectory.

        Returns whether the clock was set back since the last match, and the motion over it is not known.
        """
        unknown, self._set_back = self._set_back is not None, None
        self.last_matched = stamp_ns, pose_odom_body
        return unknown

    def velocity(self) -> np.ndarray:
        """Return the body twist (m/s, m/s, rad/s) over the last 0.15 s or the last scan interval."""
        if len(self.poses) < 2:
            return np.zeros(3)
        i = len(self.stamps) - 2
        while i > 0 and self.stamps[-1] - self.stamps[i] < 0.15 / NS:
            i -= 1
        dt = (self.stamps[-1] - self.stamps[i]) * NS
        if not 0.02 < dt < 1.5:
            return np.zeros(3)
        return twist(se2.between(self.poses[i], self.poses[-1]), dt)

    def predict(self, stamp_ns: int) -> tuple[Prediction, list[tuple[MotionErrorModel, np.ndarray]]]:
        """Return the motion prediction with the lowest recent error, and all predictions with error models.

        Predictions are by constant velocity, standstill and wheel odometry; while dead reckoning is active,
        its prediction is returned. Pass the second value to `accept`.
        """
        if (self._set_back or self.is_in_gap(stamp_ns)) and (gap := self._predict_over_gap(stamp_ns)):
            return gap, []
        dt = (stamp_ns - self.stamps[-1]) * NS
        steady = exp_twist(self.velocity(), min(dt, self.settings.extrapolate_s))
        # Stamps of real logs are irregular; then standstill predicts better than constant velocity.
        predictions = [
            (self._velocity_error, steady, "constant velocity"),
            (self._standstill_error, np.zeros(3), "standstill"),
        ]
        wheels = self.odometry.increment(self.stamps[-1], stamp_ns)
        if wheels is not None and self._is_plausible(wheels, dt) and self.odometry.calibration.usable:
            predictions.append((self._wheel_error, wheels, "wheels"))
        reckoned = self.reckoning.predict(stamp_ns)
        if reckoned is not None:
            motion = se2.between(self.poses[-1], reckoned)
            if self._is_plausible(motion, dt):
                sigma_rad = self._wheel_error.sigmas(motion, dt)[1]
                reckoned_motion = Prediction(motion, WHEEL_SIGMA_M, sigma_rad, "wheels", False)
                return reckoned_motion, [(model, motion) for model, motion, _ in predictions]
        rated = []
        for model, motion, name in predictions:
            sigma_m, sigma_rad = model.sigmas(motion, dt)
            rated.append(
                (
                    sigma_m / 0.05 + sigma_rad / 0.03,
                    Prediction(motion, sigma_m, sigma_rad, name, False),
                )
            )
        best = min(rated, key=lambda item: item[0])[1]
        return best, [(model, motion) for model, motion, _ in predictions]

    def _predict_over_gap(self, stamp_ns: int) -> Prediction | None:
        """Return the motion since the last scan, where the last good match is long ago.

        None if wheel odometry without a gap covers the time.
        """
        if not self._set_back and self.odometry.is_continuous(self.last_matched[0], stamp_ns):
            return None
        moved = self.gap_motion(stamp_ns)
        if moved is None and not self.is_in_gap(stamp_ns):
            return None
        if moved is None:
            dt = (stamp_ns - self.last_matched[0]) * NS
            sigma_m, sigma_rad = self._standstill_error.sigmas(np.zeros(3), dt)
            pose, source = self.last_matched[1], "standstill"
        else:
            sigma_m, sigma_rad = moved.sigma_m, moved.sigma_rad
            pose, source = se2.compose(self.last_matched[1], moved.motion), "wheels"
        return Prediction(se2.between(self.poses[-1], pose), sigma_m, sigma_rad, source, True)

    def is_in_gap(self, stamp_ns: int) -> bool:
        """Return whether the last good match is so long ago that the pose may be elsewhere in the map."""
        return (stamp_ns - self.last_matched[0]) * NS > 1.0

    def gap_motion(self, stamp_ns: int) -> Prediction | None:
        """Return the motion by the wheels since the last good match, None if the wheels do not tell it."""
        if self._set_back is not None:
            moved = self.odometry.motion_over_set_back(self._set_back[0], stamp_ns)
            if moved is None:
                return None
            sigma_m, sigma_rad = self._wheel_error.sigmas(moved, 0.0)
            return Prediction(moved, POSITION_SIGMA_M + sigma_m, sigma_rad, "wheels", True)
        over_gap = self.odometry.motion_over_gap(self.last_matched[0], stamp_ns)
        dt = (stamp_ns - self.last_matched[0]) * NS
        if over_gap is None or not self._is_plausible(over_gap.motion, dt):
            return None
        return Prediction(over_gap.motion, over_gap.sigma_m, over_gap.sigma_rad, "wheels", dt > 1.0)

    def _is_plausible(self, motion: np.ndarray, dt_s: float) -> bool:
        """Return whether a motion is within the speed limits of the settings."""
        s = self.settings
        margin = dt_s + 0.2  # tolerance for stamp jitter
        return math.hypot(motion[0], motion[1]) < s.max_speed_m_s * margin and abs(motion[2]) < (
            s.max_yaw_rate_rad_s * margin
        )

    def scan_velocity(self, raw: RawScan, motion: np.ndarray | None) -> np.ndarray:
        """Return the predicted body twist during a scan.

        `motion` [3] is the predicted motion since the last scan; None for the first scan. That scan and one
        after a gap only have wheel odometry. Otherwise the odometry up to the end of the scan is not known
        yet, and the twist is estimated with the pose.
        """
        if duration_s(raw) <= 0.0:
            return np.zeros(3)
        dt = (raw.stamp_ns - self.stamps[-1]) * NS if motion is not None else math.inf
        if motion is not None and 0.02 < dt < 0.5:
            return twist(motion, dt)
        wheels = self._wheel_twist(raw)
        return self.velocity() if wheels is None else wheels

    def _wheel_twist(self, raw: RawScan) -> np.ndarray | None:
        """Return the body twist during a scan by the wheels, None without odometry at both of its ends."""
        duration = duration_s(raw)
        wheels = self.odometry.increment(raw.stamp_ns, raw.stamp_ns + round(duration / NS))
        if wheels is None or not self._is_plausible(wheels, duration):
            return None
        return twist(wheels, duration)

    def can_deskew(self, raw: RawScan) -> bool:
        """Return whether the twist during a scan after a gap is known, so that it can start a segment."""
        return duration_s(raw) <= 0.0 or self._wheel_twist(raw) is not None

    def accept(
        self,
        stamp_ns: int,
        pose_odom_body: np.ndarray,
        predictions: list[tuple[MotionErrorModel, np.ndarray]],
        predicted_twist: np.ndarray | None = None,
        matched: bool = True,
    ) -> None:
        """Append the pose of the newest scan; update the error models and the estimated odometry errors.

        Args:
            predictions: of `predict`; empty if the match was not accepted.
            predicted_twist: float64 [3], `scan_velocity` before the match.
            matched: whether the pose is that of an accepted match.
        """
        if matched:
            self.last_matched, self._set_back = (stamp_ns, pose_odom_body), None
        if self.poses:
            moved = se2.between(self.poses[-1], pose_odom_body)
            for model, motion in predictions:
                model.update(motion, moved)
            dt = (stamp_ns - self.stamps[-1]) * NS
            if self._predicted_twist is not None and predictions and 0.02 < dt < 0.5:
                self.twist_error.update(self._predicted_twist, twist(moved, dt))
            self._predicted_twist = predicted_twist if predictions else None
            observed = bool(predictions) and not self.reckoning.degenerate
            self.odometry.observe(self.stamps[-1], stamp_ns, moved if observed else None)
        self.stamps.append(stamp_ns)
        self.poses.append(pose_odom_body)
        if len(self.stamps) > 512:
            del self.stamps[:256], self.poses[:256]
