"""Scan-to-map matching: robust Gauss-Newton on surface elements from a given start pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.matching_kernels import count_overlapping_returns, gauss_newton
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import MatchTables

ANNEAL_SCALES = (3.0, 2.0, 1.4)  # factors on the outlier scale in the first iterations; then 1
NO_TIMES = np.empty(0)


@dataclass(frozen=True)
class Match:
    """Pose of a scan in a map, with its information and quality.

    The target frame is the frame of the map: a submap or the global map.
    """

    pose_target_body: np.ndarray  # float64 [3]
    information: np.ndarray  # float64 [3, 3] of the scan alone; axes of the target frame, yaw about the body
    inlier_ratio: float  # returns on surfaces / returns in observed space
    overlap: float  # returns in observed space / all returns
    residual_m: float  # robust RMS distance to the surfaces
    full_information: np.ndarray | None = None  # before a reduction by observability.reduce_unobservable()
    # float64 [3], m/s, m/s, rad/s in body axes: the twist during the scan minus that of its deskewing
    twist_correction: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class TwistPrior:
    """Prior of the twist during a scan, for its estimation together with the pose."""

    times_s: np.ndarray  # float64 [K], time of each return after the stamp
    correction: np.ndarray  # float64 [3], body axes: expected twist minus the twist of the deskewing
    sigma_m_s: float
    sigma_rad_s: float


def refine(
    points: np.ndarray,  # float64 [K, 5], PreparedScan.features()
    origin: np.ndarray,  # float64 [2]
    start_pose: np.ndarray,
    tables: MatchTables,
    settings: LidarSlamSettings,
    prior_pose: np.ndarray | None = None,
    prior_information: np.ndarray | None = None,
    iterations: int = 15,
    anneal: tuple[float, ...] = ANNEAL_SCALES,
    twist_prior: TwistPrior | None = None,
) -> Match:
    """Return the match of a scan, refined by Gauss-Newton from `start_pose` [3].

    With `twist_prior`, the twist during the scan is estimated too.
    """
    pose, twist, H = np.empty(3), np.empty(3), np.empty((3, 3))
    sigma_m = math.hypot(settings.range_sigma_m, settings.map_sigma_m)
    if prior_pose is None or prior_information is None:
        prior_pose, prior_information = start_pose, np.zeros((3, 3))
    turn = np.array([0.0, 0.0, start_pose[2]])
    times_s, prior_twist, twist_information = NO_TIMES, np.zeros(3), NO_TIMES
    if twist_prior is not None:
        times_s = twist_prior.times_s
        prior_twist[:2] = se2.transform(turn, twist_prior.correction[None, :2])[0]
        prior_twist[2] = twist_prior.correction[2]
        twist_information = np.array([twist_prior.sigma_m_s] * 2 + [twist_prior.sigma_rad_s]) ** -2.0
    weights, _, cost = gauss_newton(
        points,
        times_s,
        origin,
        start_pose,
        tables.nearest,
        tables.means,
        tables.omegas,
        tables.views,
        tables.row0,
        tables.col0,
        tables.cell_m,
        prior_pose,
        prior_information,
        prior_twist,
        twist_information,
        settings.outlier_m / sigma_m,
        settings.returns_per_measurement,
        np.array(anneal),
        iterations,
        pose,
        twist,
        H,
    )
    n = max(len(points), 1)
    overlapping = count_overlapping_returns(
        points, pose, tables.nearest, tables.misses, tables.row0, tables.col0, tables.cell_m
    )
    residual = sigma_m * math.sqrt(max(cost, 0.0) / weights) if weights > 0 else math.inf
    correction = np.array([*se2.transform(-turn, twist[None, :2])[0], twist[2]])
    return Match(
        pose, H, weights / max(overlapping, 1), overlapping / n, residual, twist_correction=correction
    )
