"""Covariance of the published pose: error of the motion over the last second.

The pose in the frame `odom` drifts without bound, so its absolute error has no useful covariance. What is
stated is the error of the motion since the pose one second before.
"""

from __future__ import annotations

import math

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.scan_matching import Match
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings

SPAN_NS = 1_000_000_000
# Relative error of the travelled distance: prior and deskewing take a part of the error of the wheels. This
# and the delay were measured on simulated drives of seeds 201, 204 and 103 and on house_a.
TRAVEL_ERROR = 0.0035
YAW_DELAY_S = 0.004  # a change of the yaw rate within a scan acts like a delay of its yaw
MIN_RESIDUAL_M = 0.004  # a match with fewer surfaces than degrees of freedom has no residual
UNKNOWN = np.diag([1.0, 1.0, 0.1])  # m^2, m^2, rad^2: of a pose that no match supports


def motion_covariance(
    match: Match,
    target_yaw_rad: float,
    stamps_ns: list[int],
    poses: list[np.ndarray],
    settings: LidarSlamSettings,
) -> np.ndarray:
    """Return the covariance [3, 3] of the error of (x, y, yaw) over the last second, x and y in odom axes.

    It is the sum of the noise of the match, an error of yaw in proportion to the yaw rate, and errors in
    proportion to the distance travelled: along the motion by the wheels, across it by the error of yaw.

    The noise of the match is its inverse information, scaled by the residual of the scan. Residuals of
    neighbouring returns count as independent, because the errors that they share are those of the map, which
    cancel over a second.

    Args:
        match: the accepted match; axes of its target frame.
        target_yaw_rad: yaw of the target frame in odom.
        stamps_ns: stamps of the poses, the newest last.
        poses: pose_odom_body [3] of each stamp.
        settings: standard deviations that the information of the match was computed with.
    """
    stated_m = math.hypot(settings.range_sigma_m, settings.map_sigma_m)
    residual_m = min(max(match.residual_m, MIN_RESIDUAL_M), settings.outlier_m)
    information = match.information * (settings.returns_per_measurement * (stated_m / residual_m) ** 2)
    # (3 m)^-2 and (0.5 rad)^-2 keep the inverse finite in unobservable directions.
    noise = np.linalg.inv(information + np.diag([0.1, 0.1, 4.0]))
    covariance = se2.rotate_covariance(noise, target_yaw_rad)
    first = len(stamps_ns) - 1
    rate_rad_s = 0.0
    while first > 0 and stamps_ns[-1] - stamps_ns[first - 1] <= SPAN_NS:
        first -= 1
        dt_s = (stamps_ns[first + 1] - stamps_ns[first]) * 1e-9
        turn = math.remainder(poses[first + 1][2] - poses[first][2], math.tau)
        rate_rad_s = max(rate_rad_s, abs(turn) / dt_s)
    covariance[2, 2] += (YAW_DELAY_S * rate_rad_s) ** 2
    travel = (poses[-1] - poses[first])[:2]
    along = TRAVEL_ERROR * travel
    across = math.sqrt(covariance[2, 2]) * np.array([-travel[1], travel[0]])  # by the yaw error at its start
    covariance[:2, :2] += np.outer(along, along) + np.outer(across, across)
    return covariance
