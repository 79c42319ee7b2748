"""Observability of a match: detects directions along which the scan can be shifted, as in a corridor."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d.matching_kernels import accumulate
from beamsplat.services.localization.lidar2d.scan_matching import Match
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import MatchTables

# Shifts of the scan that are tested along the weak direction.
SHIFTS_M = np.array([-0.45, -0.3, -0.15, 0.15, 0.3, 0.45])
MIN_DISAGREEMENT_RATIO = 0.10  # fraction of the returns that must disagree with every shift for full trust


@kernel
def weights_when_shifted(
    points: np.ndarray,
    origin: np.ndarray,
    pose: np.ndarray,
    direction: np.ndarray,
    shifts_m: np.ndarray,
    nearest: np.ndarray,
    means: np.ndarray,
    omegas: np.ndarray,
    views: np.ndarray,
    row0: int,
    col0: int,
    cell_m: float,
    scale2: float,
    out: np.ndarray,
) -> float:
    """Return the sum of robust weights of the returns at `pose`; write the sums at shifted poses to `out`.

    `out` is float64 [K]; the shifts are `shifts_m` float64 [K] along `direction`. A sum that is almost as
    large at a shifted pose shows that the match is not observable in this direction.
    """
    H, g, moved, still, no_times = np.empty((3, 3)), np.empty(3), np.empty(3), np.zeros(3), np.empty(0)
    here, _, _ = accumulate(
        points, no_times, origin, pose, still, nearest, means, omegas, views, row0, col0, cell_m, scale2, H, g
    )
    for k in range(shifts_m.shape[0]):
        moved[0] = pose[0] + shifts_m[k] * direction[0]
        moved[1] = pose[1] + shifts_m[k] * direction[1]
        moved[2] = pose[2]
        out[k], _, _ = accumulate(
            points,
            no_times,
            origin,
            moved,
            still,
            nearest,
            means,
            omegas,
            views,
            row0,
            col0,
            cell_m,
            scale2,
            H,
            g,
        )
    return here


@kernel
def weak_direction(information: np.ndarray) -> np.ndarray:
    """Return the unit vector [2] of the least certain translation (yaw marginalised)."""
    yaw = max(information[2, 2], 1e-9)
    xx = information[0, 0] - information[0, 2] * information[2, 0] / yaw
    xy = information[0, 1] - information[0, 2] * information[2, 1] / yaw
    yy = information[1, 1] - information[1, 2] * information[2, 1] / yaw
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)  # of the most certain axis
    return np.array([-math.sin(angle), math.cos(angle)])


@dataclasses.dataclass(frozen=True)
class ObservedMatch:
    """A match, with its least certain direction and the observability along this direction."""

    match: Match  # with reduced information
    trust: float  # 0 (unobservable) .. 1 (fully observable)
    direction: np.ndarray  # float64 [2], unit vector in the axes of the map


def reduce_unobservable(
    points: np.ndarray,  # float64 [K, 5]
    origin: np.ndarray,
    match: Match,
    tables: MatchTables,
    settings: LidarSlamSettings,
) -> ObservedMatch:
    """Reduce the information of a match along its weak direction, if a shifted scan fits almost as well.

    The information along the direction is multiplied by trust^2. `full_information` is the original.
    """
    direction = weak_direction(match.information)
    if len(points) == 0:
        return ObservedMatch(match, 0.0, direction)
    sigma_m = math.hypot(settings.range_sigma_m, settings.map_sigma_m)
    shifted = np.empty(len(SHIFTS_M))
    here = weights_when_shifted(
        points,
        origin,
        match.pose_target_body,
        direction,
        SHIFTS_M,
        tables.nearest,
        tables.means,
        tables.omegas,
        tables.views,
        tables.row0,
        tables.col0,
        tables.cell_m,
        (settings.outlier_m / sigma_m) ** 2,
        shifted,
    )
    overlapping = max(match.overlap * len(points), 1.0)
    trust = min(max((here - float(shifted.max())) / (MIN_DISAGREEMENT_RATIO * overlapping), 0.0), 1.0)
    if trust >= 1.0:
        return ObservedMatch(match, 1.0, direction)
    v = np.array([direction[0], direction[1], 0.0])
    along = match.information @ v
    reduced = match.information - (1.0 - trust**2) * np.outer(along, along) / max(float(v @ along), 1e-9)
    return ObservedMatch(
        dataclasses.replace(match, information=reduced, full_information=match.information), trust, direction
    )


def keep_guess_if_unobservable(observed: ObservedMatch, guess_pose: np.ndarray) -> Match:
    """Return the match with its pose moved back to `guess_pose` [3] along the unobservable direction."""
    match, v = observed.match, observed.direction
    if observed.trust >= 1.0:
        return match
    correction = (1.0 - observed.trust**2) * float((guess_pose - match.pose_target_body)[:2] @ v)
    pose = match.pose_target_body.copy()
    pose[:2] += correction * v
    return dataclasses.replace(match, pose_target_body=pose)
