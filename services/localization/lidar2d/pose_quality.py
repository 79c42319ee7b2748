"""Quality of a pose: the probability that the motion over the last second is accurate, and what limits it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d.scan_matching import Match
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings

ACCURATE_M, ACCURATE_RAD = 0.02, math.radians(0.5)  # limits of the error of an accurate motion
MIN_OVERLAP = 0.5  # of the returns with mapped space, below which the quality has this reason
SUFFICIENT = 0.9  # a quality from which no reason is given


@dataclass(frozen=True)
class PoseQuality:
    """Quality 0 .. 1 of a pose, and in words what limits it ("" if it is good)."""

    value: float
    reason: str


def pose_quality(covariance: np.ndarray) -> float:
    """Return the probability that the errors of a motion are below 2 cm and 0.5 degrees.

    The errors are taken as normally distributed and independent along the principal axes of the position.

    Args:
        covariance: float64 [3, 3] of (x, y, yaw), `motion_covariance.motion_covariance`.
    """
    variances = np.maximum(np.linalg.eigvalsh(covariance[:2, :2]), 0.0)
    probability = math.erf(ACCURATE_RAD / math.sqrt(2.0 * max(covariance[2, 2], 1e-12)))
    for variance in variances:
        probability *= math.erf(ACCURATE_M / math.sqrt(2.0 * max(float(variance), 1e-12)))
    return probability


def rate_pose(
    covariance: np.ndarray, match: Match, degenerate: bool, settings: LidarSlamSettings
) -> PoseQuality:
    """Return the quality of a matched pose.

    Args:
        degenerate: the pose is not observable in one direction.
    """
    value = pose_quality(covariance)
    if value >= SUFFICIENT:
        return PoseQuality(value, "")
    if degenerate:
        return PoseQuality(value, "the scan does not show the position along one direction, as in a corridor")
    if match.inlier_ratio < settings.good_inlier_ratio:
        return PoseQuality(value, f"{match.inlier_ratio:.0%} of the returns agree with the map")
    if match.overlap < MIN_OVERLAP:
        return PoseQuality(value, f"{match.overlap:.0%} of the returns are in mapped space")
    if covariance[2, 2] > (0.5 * ACCURATE_RAD) ** 2:
        return PoseQuality(value, "the yaw is uncertain: the robot turns fast, or few surfaces are far away")
    return PoseQuality(value, "few surfaces determine the position")


LOST = PoseQuality(0.0, "the scan does not match the map")
