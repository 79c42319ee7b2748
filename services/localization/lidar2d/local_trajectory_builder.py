"""The front end: estimates a smooth pose in the odom frame per scan; it never waits for loop closure."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.correlative import search
from beamsplat.services.localization.lidar2d.dead_reckoning import WHEEL_SIGMA_M, DeadReckoning
from beamsplat.services.localization.lidar2d.observability import ObservedMatch, reduce_unobservable
from beamsplat.services.localization.lidar2d.odometry import MotionErrorModel, OdometryBuffer
from beamsplat.services.localization.lidar2d.scan import PreparedScan, prepare_scan
from beamsplat.services.localization.lidar2d.scan_matching import Match, TwistPrior, refine
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import SurfelMap
from beamsplat.services.localization.lidar2d.twist import TwistErrorModel, exp_twist, twist

NS = 1e-9
# Over a gap, wheels are taken to err by these ratios of a path at this speed.
GAP_SPEED_M_S, GAP_ERROR_RATIO, GAP_RAD_PER_M = 0.5, 0.1, 0.02
MATCHED_GAP_M = 3.0  # a longer motion over a gap leaves the local map: the scan is not matched to it
MATCHED_GAP_S = 3.0  # likewise a longer time without wheels
GAP_MIN_OVERLAP = 0.6  # of a match after a gap


@dataclass(frozen=True)
class RawScan:
    """One scan (revolution or sweep) of the sensor, unprocessed; `stamp_ns` is the time of the first beam."""

    stamp_ns: int
    ranges_m: np.ndarray  # float32 [N], +inf or >= range_max_m: no return
    angle_min_rad: float
    angle_increment_rad: float
    time_increment_s: float
    range_min_m: float
    range_max_m: float


@dataclass
class LocalMap:
    """An unfinished submap: its pose in the odom frame and its surfel map, to which scans are added."""

    pose_odom_submap: np.ndarray  # float64 [3]
    surfels: SurfelMap


@dataclass(frozen=True)
class Prediction:
    """Predicted motion of the body since the last scan, with standard deviations."""

    motion: np.ndarray  # float64 [3], pose_last_now
    sigma_m: float
    sigma_rad: float
    source: str
    long_gap: bool  # no scan was matched for over 1 s, and no continuous wheel odometry covers the gap


class LocalTrajectoryBuilder:
    """Motion prediction, deskewing and scan-to-submap matching, as in Cartographer.

    The caller decides which scans are inserted into which submap.
    """

    def __init__(
        self, settings: LidarSlamSettings, pose_body_lidar: np.ndarray, upside_down: bool = False
    ) -> None:
        self.settings = settings
        self.pose_body_lidar = pose_body_lidar
        self._flip = -1.0 if upside_down else 1.0
        self.odometry = OdometryBuffer()
        self.reckoning = DeadReckoning(self.odometry)
        self._wheel_error = MotionErrorModel(0.01, 0.05, 0.02, 0.004, 0.05, 0.03)
        self._velocity_error = MotionErrorModel(0.02, 0.10, 0.3, 0.02, 0.20, 0.4)
        self._standstill_error = MotionErrorModel(0.05, 0.0, 0.3, 0.05, 0.0, 0.4)
        self._twist_error = TwistErrorModel()
        self._predicted_twist: np.ndarray | None = None  # float64 [3], for the interval after the last pose
        self._covariance_odom = np.zeros((3, 3))  # of the last matched pose in its submap; odom axes
        self.stamps: list[int] = []  # recent stamps and poses, newest last
        self.poses: list[np.ndarray] = []
        self.last_matched: tuple[int, np.ndarray] = (0, np.zeros(3))  # stamp and pose of the last good match

    def restart_clock(self, stamp_ns: int) -> None:
        """Continue from the last pose at the stamp `stamp_ns`, after the clock was set to another time."""
        if self.poses:
            self.stamps, self.poses = [stamp_ns - round(0.1 / NS)], [self.poses[-1]]
            self.last_matched = self.stamps[-1], self.poses[-1]
            self.reckoning.restart(stamp_ns, self.poses[-1])

    # ---- motion -----------------------------------------------------------------------------------

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
        if self.is_in_gap(stamp_ns) and (gap := self._predict_over_gap(stamp_ns)):
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
        if self.odometry.increment(self.last_matched[0], stamp_ns) is not None:
            return None
        moved = self.gap_motion(stamp_ns)
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
        """Return the motion by the wheels since the last good match, None if the wheels do not tell it.

        The path between both is unknown, as are slip and bias on it: the uncertainty grows with the distance
        that could have been driven.
        """
        motion = self.odometry.displacement(self.last_matched[0], stamp_ns)
        dt = (stamp_ns - self.last_matched[0]) * NS
        if motion is None or not self._is_plausible(motion, dt):
            return None
        distance = math.hypot(motion[0], motion[1])
        unseen_m = min(GAP_SPEED_M_S * dt, 2.0 * distance + 2.0)
        return Prediction(
            motion, 0.05 + GAP_ERROR_RATIO * unseen_m, 0.02 + GAP_RAD_PER_M * unseen_m, "wheels", dt > 1.0
        )

    def _is_plausible(self, motion: np.ndarray, dt_s: float) -> bool:
        """Return whether a motion is within the speed limits of the settings."""
        s = self.settings
        margin = dt_s + 0.2  # tolerance for stamp jitter
        return math.hypot(motion[0], motion[1]) < s.max_speed_m_s * margin and abs(motion[2]) < (
            s.max_yaw_rate_rad_s * margin
        )

    def scan_velocity(self, raw: RawScan, motion: np.ndarray | None) -> np.ndarray:
        """Return the predicted body twist during a scan.

        `motion` [3] is the predicted motion since the last scan; None for the first scan, which only has
        wheel odometry. Later the odometry up to the end of the scan is not known yet, and the twist is
        estimated with the pose.
        """
        duration = duration_s(raw)
        if duration <= 0.0:
            return np.zeros(3)
        if motion is None:
            wheels = self.odometry.increment(raw.stamp_ns, raw.stamp_ns + round(duration / NS))
            plausible = wheels is not None and self._is_plausible(wheels, duration)
            return twist(wheels, duration) if wheels is not None and plausible else np.zeros(3)
        dt = (raw.stamp_ns - self.stamps[-1]) * NS
        return twist(motion, dt) if 0.02 < dt < 0.5 else self.velocity()

    def prepare(self, raw: RawScan, velocity: np.ndarray) -> PreparedScan:
        """Filter and deskew a scan; `velocity` is the body twist [3] (m/s, m/s, rad/s) during the scan."""
        s = self.settings
        return prepare_scan(
            raw.ranges_m,
            self._flip * raw.angle_min_rad,
            self._flip * raw.angle_increment_rad,
            raw.time_increment_s,
            raw.range_min_m,
            min(raw.range_max_m, s.use_range_m),
            self.pose_body_lidar,
            velocity,
            s.min_spacing_m,
            s.max_match_points,
        )

    # ---- matching ---------------------------------------------------------------------------------

    def match(
        self,
        raw: RawScan,
        scan: PreparedScan,
        velocity: np.ndarray,
        prediction: Prediction,
        local: LocalMap,
    ) -> tuple[PreparedScan, Match, bool]:
        """Match the scan to the local map; return the scan, the match, and whether the match is accepted.

        Gauss-Newton starts at the prediction, and estimates the twist during the scan too if its beams have
        times. Correlative search is added if the prediction is uncertain or the match is poor. The scan is
        then deskewed again with the matched twist and matched once more.

        Args:
            velocity: float64 [3], the predicted twist, with which `scan` was deskewed.
        """
        s = self.settings
        if prediction.long_gap and self._has_left(raw.stamp_ns, prediction):
            return scan, Match(np.zeros(3), np.zeros((3, 3)), 0.0, 0.0, math.inf), False
        pose_submap_last = se2.between(local.pose_odom_submap, self.poses[-1])
        guess_pose = se2.compose(pose_submap_last, prediction.motion)
        information = self._prior_information(prediction, local)
        tables = local.surfels.tables()
        predicted = velocity
        prior = self._twist_prior(raw, scan, predicted, velocity)
        match = refine(
            scan.features(),
            scan.origin_body,
            guess_pose,
            tables,
            s,
            guess_pose,
            information,
            twist_prior=prior,
        )
        long_gap = prediction.long_gap
        window_m = min(max(3.0 * prediction.sigma_m, s.search_min_m), 2.0 if long_gap else s.search_max_m)
        window_rad = min(
            max(3.0 * prediction.sigma_rad, s.search_min_rad), math.pi if long_gap else s.search_max_rad
        )
        if window_m > s.search_min_m or window_rad > s.search_min_rad:
            match = self._search(
                scan, match, guess_pose, guess_pose, information, local, window_m, window_rad
            )
        if (
            match.inlier_ratio < s.good_inlier_ratio
        ):  # the prediction may be wrong: search around the last pose
            wider_m, wider_rad = max(window_m, 0.4), max(window_rad, math.radians(20.0))
            match = self._search(
                scan, match, guess_pose, pose_submap_last, information, local, wider_m, wider_rad
            )
        if match.inlier_ratio < s.lost_inlier_ratio:
            match = self._search(
                scan,
                match,
                guess_pose,
                pose_submap_last,
                information,
                local,
                s.search_max_m,
                s.search_max_rad,
            )
        if prior is not None:
            velocity = velocity + match.twist_correction
            scan = self.prepare(raw, velocity)
            prior = self._twist_prior(raw, scan, predicted, velocity)
            match = refine(
                scan.features(),
                scan.origin_body,
                match.pose_target_body,
                tables,
                s,
                guess_pose,
                information,
                anneal=(1.0,),
                twist_prior=prior,
            )
        if not self._is_trusted(prediction, guess_pose, match):
            self._covariance_odom += np.diag([prediction.sigma_m**2] * 2 + [prediction.sigma_rad**2])
            return scan, match, False
        self._covariance_odom = se2.rotate_covariance(
            np.linalg.inv(match.information + information), local.pose_odom_submap[2]
        )
        observed = reduce_unobservable(scan.features(), scan.origin_body, match, tables, s)
        return scan, self._apply_dead_reckoning(raw.stamp_ns, local, observed), True

    def _prior_information(self, prediction: Prediction, local: LocalMap) -> np.ndarray:
        """Return the information [3, 3] of the predicted pose in the local map.

        Its covariance is that of the last pose plus that of the motion (Kalman filter). A bias of the wheels
        persists over many scans: n priors of one sigma each, taken as independent, would outweigh the scans
        and bend long corridors. Therefore the variance of the motion is multiplied by n.
        """
        last = se2.rotate_covariance(self._covariance_odom, -local.pose_odom_submap[2])
        motion = np.diag([prediction.sigma_m**2, prediction.sigma_m**2, prediction.sigma_rad**2])
        return np.linalg.inv(last + self.settings.prior_correlation_scans * motion)

    def _twist_prior(
        self, raw: RawScan, scan: PreparedScan, predicted: np.ndarray, velocity: np.ndarray
    ) -> TwistPrior | None:
        """Return the prior of the twist during a scan, around `predicted` [3]; None without beam times.

        The scan was deskewed with the twist `velocity` [3].
        """
        duration = duration_s(raw)
        if duration <= 0.0:
            return None
        times_s = raw.time_increment_s * scan.beams[scan.match_index].astype(np.float64)
        return TwistPrior(times_s, predicted - velocity, *self._twist_error.sigmas(duration))

    def _has_left(self, stamp_ns: int, prediction: Prediction) -> bool:
        """Return whether the robot may be outside the local map after a gap."""
        if prediction.source != "wheels":
            return (stamp_ns - self.last_matched[0]) * NS > MATCHED_GAP_S
        moved = se2.compose(self.poses[-1], prediction.motion) - self.last_matched[1]
        return math.hypot(moved[0], moved[1]) > MATCHED_GAP_M

    def _apply_dead_reckoning(self, stamp_ns: int, local: LocalMap, seen: ObservedMatch) -> Match:
        """Return the match, corrected along its weak direction by dead reckoning if it is degenerate."""
        pose_odom_submap = local.pose_odom_submap
        turn = np.array([0.0, 0.0, pose_odom_submap[2]])
        direction_odom = se2.transform(turn, seen.direction[None])[0]
        pose_odom_body = se2.compose(pose_odom_submap, seen.match.pose_target_body)
        corrected, reckoned = self.reckoning.correct(stamp_ns, pose_odom_body, seen.trust, direction_odom)
        if not reckoned:
            return seen.match
        v = np.array([*seen.direction, 0.0])
        information = seen.match.information + (1.0 - seen.trust**2) * np.outer(v, v) / WHEEL_SIGMA_M**2
        pose_map_body = se2.between(pose_odom_submap, corrected)
        return dataclasses.replace(seen.match, pose_target_body=pose_map_body, information=information)

    def _is_trusted(self, prediction: Prediction, guess_pose: np.ndarray, match: Match) -> bool:
        """Return whether the inlier ratio is high enough to accept the match.

        The limit is higher if the match is far from the prediction or if there is no prediction.
        """
        s = self.settings
        off = se2.between(guess_pose, match.pose_target_body)
        far = math.hypot(off[0], off[1]) > 0.2 + 3.0 * prediction.sigma_m or abs(off[2]) > (
            0.15 + 3.0 * prediction.sigma_rad
        )
        if prediction.long_gap:
            known = prediction.source == "wheels" and not far
            limit = s.good_inlier_ratio if known else s.sure_inlier_ratio
            return match.inlier_ratio >= limit and match.overlap >= GAP_MIN_OVERLAP
        return match.inlier_ratio >= (s.sure_inlier_ratio if far else s.lost_inlier_ratio)

    def _search(
        self,
        scan: PreparedScan,
        best: Match,
        prior_pose: np.ndarray,
        centre_pose: np.ndarray,
        information: np.ndarray,
        local: LocalMap,
        window_m: float,
        window_rad: float,
    ) -> Match:
        """Search a window around `centre_pose` by correlative matching; return the best match, or `best`."""
        tables, s = local.surfels.tables(), self.settings
        points = scan.features()
        for _, start_pose in search(points, centre_pose, tables, window_m, window_rad, prior_weight=0.02):
            other = refine(points, scan.origin_body, start_pose, tables, s, prior_pose, information)
            if other.inlier_ratio * other.overlap > best.inlier_ratio * best.overlap + 0.02:
                best = other
        return best

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
            self.last_matched = stamp_ns, pose_odom_body
        if self.poses:
            moved = se2.between(self.poses[-1], pose_odom_body)
            for model, motion in predictions:
                model.update(motion, moved)
            dt = (stamp_ns - self.stamps[-1]) * NS
            if self._predicted_twist is not None and predictions and 0.02 < dt < 0.5:
                self._twist_error.update(self._predicted_twist, twist(moved, dt))
            self._predicted_twist = predicted_twist if predictions else None
            observed = bool(predictions) and not self.reckoning.degenerate
            self.odometry.observe(self.stamps[-1], stamp_ns, moved if observed else None)
        self.stamps.append(stamp_ns)
        self.poses.append(pose_odom_body)
        if len(self.stamps) > 512:
            del self.stamps[:256], self.poses[:256]


def duration_s(raw: RawScan) -> float:
    """Return the time from the first to after the last beam of a scan."""
    return raw.time_increment_s * len(raw.ranges_m)
