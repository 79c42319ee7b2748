"""Motion by the wheels over a stretch without matched scans, with the errors that the drive has shown."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.odometry_calibration import OdometryCalibration

UNUSABLE_RATIO, UNUSABLE_RAD_PER_M = 0.1, 0.02  # errors of wheels that disagree with the scans
POSITION_SIGMA_M, HEADING_SIGMA_RAD = 0.05, 0.005  # of any motion over a gap: stamps, matches at both ends


@dataclass(frozen=True)
class GapMotion:
    """Motion of the body over a stretch by the wheels, with standard deviations."""

    motion: np.ndarray  # float64 [3]
    sigma_m: float
    sigma_rad: float


def motion_over_gap(
    poses: np.ndarray,  # float64 [N, 3] by the wheels, from the start to the end of the stretch
    intervals_s: np.ndarray,  # float64 [N - 1] between them
    silent_s: float,  # the path over longer intervals is unknown
    calibration: OdometryCalibration,
) -> GapMotion:
    """Return the motion over a stretch, with the estimated scales and turn per metre.

    The standard deviation of the position is that in the worst direction. While nothing is heard, the path is
    taken to be as long as the usual speed allows, and at most twice as long as its displacement.
    """
    heading = calibration.heading
    steps = calibration.apply(se2.between_many(poses[:-1], poses[1:]))
    lengths_m = np.hypot(steps[:, 0], steps[:, 1])
    silent = intervals_s > silent_s
    likely_m = np.minimum(heading.speed_m_s * intervals_s, 2.0 * lengths_m + 2.0)
    lengths_m[silent] = np.maximum(lengths_m, likely_m)[silent]
    turned_rad = float(np.abs(steps[:, 2]).sum()) + (math.pi if silent.any() else 0.0)
    bend_rad = heading.turn_rad_per_m * lengths_m
    yaw_rad = np.cumsum(steps[:, 2] + bend_rad)
    along_rad = yaw_rad - steps[:, 2] - bend_rad / 2.0  # frame of each step
    cos, sin = np.cos(along_rad), np.sin(along_rad)
    moves = np.column_stack([cos * steps[:, 0] - sin * steps[:, 1], sin * steps[:, 0] + cos * steps[:, 1]])
    ends = np.cumsum(moves, axis=0)
    motion = np.array([*ends[-1], se2.wrap(float(yaw_rad[-1]))])
    length_m = float(lengths_m.sum())
    if not calibration.usable:
        sigma_m = POSITION_SIGMA_M + UNUSABLE_RATIO * length_m
        return GapMotion(motion, sigma_m, HEADING_SIGMA_RAD + UNUSABLE_RAD_PER_M * length_m)
    # A turn on the way moves the end by its distance from there.
    lever_m = ends[-1] - (ends - moves / 2.0)
    lever2_m2 = (lever_m**2).sum(axis=1) + np.where(silent, lengths_m**2 / 3.0, 0.0)
    var_rad = heading.variance_rad2(length_m) + (calibration.turn.sigma * turned_rad) ** 2
    var_m = (
        (calibration.distance.sigma * length_m) ** 2
        + calibration.distance_random * length_m
        + var_rad * float((lengths_m * lever2_m2).sum()) / max(length_m, 1e-9)
    )
    return GapMotion(
        motion, math.sqrt(POSITION_SIGMA_M**2 + var_m), math.sqrt(HEADING_SIGMA_RAD**2 + var_rad)
    )
