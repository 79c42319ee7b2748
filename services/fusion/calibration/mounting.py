"""Check of the lidar mounting: as calibrated, mirrored (upside down), or rotated by 180 degrees.

Scans of a drive are transformed by poses of another source (wheels, camera, motion capture). The scans agree
only if the direction of rotation and the zero direction of the lidar are correct. Poses estimated from the
same scans would hide the fault, because such poses are mirrored together with the scans.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from beamsplat.common.geometry.transforms import inverse, so3_exp, transform_points, yaw_of

_CLIP_M = 0.5  # largest distance of a point that is counted
_MAX_PAIRS = 40
_CLEARLY = 0.7  # another mounting is accepted if its misfit is below this share of the present one

_FLIP = np.diag([1.0, -1.0, 1.0])
_HALF_TURN = so3_exp(np.array([0.0, 0.0, np.pi]))
_MOUNTINGS: dict[str, np.ndarray] = {
    "as calibrated": np.eye(3),
    "mirrored (upside down, or angles counted the other way)": _FLIP,
    "turned round by 180 degrees": _HALF_TURN,
    "mirrored and turned round by 180 degrees": _HALF_TURN @ _FLIP,
}


@dataclass(frozen=True)
class MountingCheck:
    """Result of `check_mounting`: mean distance (m) between scans for each mounting, and the status."""

    misfit_m: dict[str, float]
    status: str  # "ok", or one sentence
    pairs: int


def check_mounting(
    scans_lidar_m: list[np.ndarray],  # float64 [N, 3] each
    T_map_body: list[np.ndarray],  # of each scan, from a source other than these scans
    T_body_lidar: np.ndarray,
) -> MountingCheck:
    """Return the mean distance between scans for each possible mounting, and which mounting is correct.

    The scans of a pair were taken more than 0.25 m or 0.3 rad apart.
    """
    chosen = _pairs(T_map_body)
    if len(chosen) < 4:
        return MountingCheck({}, "the robot has hardly moved: the lidar mounting cannot be checked yet", 0)
    misfit = {}
    for name, flip in _MOUNTINGS.items():
        total = []
        for i, j in chosen:
            a = transform_points(T_body_lidar, scans_lidar_m[i] @ flip.T)
            b = transform_points(T_body_lidar, scans_lidar_m[j] @ flip.T)
            moved = transform_points(inverse(T_map_body[j]) @ T_map_body[i], a)
            distance, _ = cKDTree(b[:, :2]).query(moved[::3, :2], distance_upper_bound=_CLIP_M)
            total.append(float(np.mean(np.minimum(distance, _CLIP_M))))
        misfit[name] = float(np.median(total))
    right = misfit["as calibrated"]
    best = min(misfit, key=lambda name: misfit[name])
    if misfit[best] < _CLEARLY * right:
        sentence = f"the lidar is {best}: scans then differ by {misfit[best]:.3f} m instead of {right:.3f} m"
        return MountingCheck(misfit, sentence, len(chosen))
    return MountingCheck(misfit, "ok", len(chosen))


def _pairs(T_map_body: list[np.ndarray]) -> list[tuple[int, int]]:
    out = []
    last = 0
    for i in range(1, len(T_map_body)):
        T = inverse(T_map_body[last]) @ T_map_body[i]
        if np.linalg.norm(T[:3, 3]) > 0.25 or abs(float(yaw_of(T))) > 0.3:
            out.append((last, i))
            last = i
    step = max(len(out) // _MAX_PAIRS, 1)
    return out[::step]
