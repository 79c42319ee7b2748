"""Deskewing and matching of scans to the local map; the smooth pose in the odom frame comes from here."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.correlative import search
from beamsplat.services.localization.lidar2d.dead_reckoning import WHEEL_SIGMA_M
from beamsplat.services.localization.lidar2d.motion_prediction import MotionPredictor, Prediction
from beamsplat.services.localization.lidar2d.observability import ObservedMatch, reduce_unobservable
from beamsplat.services.localization.lidar2d.scan import PreparedScan, RawScan, duration_s, prepare_scan
from beamsplat.services.localization.lidar2d.scan_matching import Match, TwistPrior, refine
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import SurfelMap

NS = 1e-9
MATCHED_GAP_M = 3.0  # a longer motion over a gap leaves the local map: the scan is not matched to it
MATCHED_GAP_S = 3.0  # likewise a longer time without wheels
GAP_MIN_OVERLAP = 0.6  # of a match after a gap


@dataclass
class LocalMap:
    """An unfinished submap: its pose in the odom frame and its surfel map, to which scans are added."""

    pose_odom_submap: np.ndarray  # float64 [3]
    surfels: SurfelMap


class LocalTrajectoryBuilder:
    """Deskewing and scan-to-submap matching, as in Cartographer.

    The caller decides which scans are inserted into which submap.
    """

    def __init__(
        self,
        settings: LidarSlamSettings,
        pose_body_lidar: np.ndarray,
        motion: MotionPredictor,
        upside_down: bool = False,
    ) -> None:
        self.settings = settings
        self.pose_body_lidar = pose_body_lidar
        self.motion = motion
        self._flip = -1.0 if upside_down else 1.0
        self._covariance_odom = np.zeros((3, 3))  # of the last matched pose in its submap; odom axes

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
        pose_submap_last = se2.between(local.pose_odom_submap, self.motion.poses[-1])
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
        return TwistPrior(times_s, predicted - velocity, *self.motion.twist_error.sigmas(duration))

    def _has_left(self, stamp_ns: int, prediction: Prediction) -> bool:
        """Return whether the robot may be outside the local map after a gap."""
        if prediction.source != "wheels":
            return (stamp_ns - self.motion.last_matched[0]) * NS > MATCHED_GAP_S
        moved = se2.compose(self.motion.poses[-1], prediction.motion) - self.motion.last_matched[1]
        return math.hypot(moved[0], moved[1]) > MATCHED_GAP_M

    def _apply_dead_reckoning(self, stamp_ns: int, local: LocalMap, seen: ObservedMatch) -> Match:
        """Return the match, corrected along its weak direction by dead reckoning if it is degenerate."""
        pose_odom_submap = local.pose_odom_submap
        turn = np.array([0.0, 0.0, pose_odom_submap[2]])
        direction_odom = se2.transform(turn, seen.direction[None])[0]
        pose_odom_body = se2.compose(pose_odom_submap, seen.match.pose_target_body)
        corrected, reckoned = self.motion.reckoning.correct(
            stamp_ns, pose_odom_body, seen.trust, direction_odom
        )
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
