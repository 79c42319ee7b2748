"""SweepAlignment of two lidar sweeps: points with normals, deskewing by a constant twist, point-to-line ICP.

ICP with the point-to-line metric: A. Censi, "An ICP variant using a point-to-line metric", ICRA 2008.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

MIN_POINTS = 15  # with a normal; fewer do not define a motion
_MAX_POINTS = 180  # of a sweep; more do not change the decisions
_GAP_M = 0.3  # neighbours on one surface are nearer than this, or than 10 beam spacings
_GATES_M = (0.8, 0.4, 0.25, 0.2, 0.2, 0.2)
_CONVERGED = 3e-4  # m and rad
RESIDUAL_CAP_M = 0.2  # a point without a counterpart counts as this


@dataclass(frozen=True)
class Sweep:
    """The returns of one scan in the lidar frame, as measured: not deskewed."""

    stamp_ns: int
    points_m: np.ndarray  # float64 [M, 2]
    fraction: np.ndarray  # float64 [M]: position in the array of ranges, -0.5 (first beam) to 0.5 (last beam)
    normals: np.ndarray  # float64 [M, 2], (0, 0) where unknown
    field_of_view_rad: float

    def __len__(self) -> int:
        return len(self.points_m)


def make_sweep(
    stamp_ns: int, ranges_m: np.ndarray, angles_rad: np.ndarray, range_min_m: float, range_max_m: float
) -> Sweep:
    """Return the valid returns of a scan: `ranges_m` float32 [N] at `angles_rad` float64 [N]."""
    n = len(ranges_m)
    ranges = ranges_m.astype(np.float64)
    with np.errstate(invalid="ignore"):
        valid = np.flatnonzero((ranges > max(range_min_m, 1e-3)) & (ranges < min(range_max_m, 60.0)))
    r, a = ranges[valid], angles_rad[valid]
    points = np.stack([r * np.cos(a), r * np.sin(a)], axis=1)
    step = abs(float(angles_rad[-1] - angles_rad[0])) / max(n - 1, 1) if n > 1 else 0.0
    normals = _normals(points, valid, r * step)
    fraction = valid / max(n - 1, 1) - 0.5
    if len(valid) > _MAX_POINTS:
        keep = np.linspace(0, len(valid) - 1, _MAX_POINTS).round().astype(int)
        points, normals, fraction = points[keep], normals[keep], fraction[keep]
    return Sweep(stamp_ns, points, fraction, normals, step * n)


def _normals(points: np.ndarray, beams: np.ndarray, spacing_m: np.ndarray) -> np.ndarray:
    """Return the surface normal of each point from its neighbours up to two beams away; (0, 0) = unknown."""
    normals = np.zeros_like(points)
    if len(points) < 3:
        return normals
    limit = np.maximum(_GAP_M, np.minimum(10.0 * spacing_m, 1.0))
    total = np.zeros_like(points)
    count = np.zeros(len(points))
    for off in (1, 2):
        along = points[off:] - points[:-off]
        distance = np.hypot(along[:, 0], along[:, 1])
        near = (beams[off:] - beams[:-off] <= off + 1) & (distance < off * limit[off:]) & (distance > 1e-6)
        unit = np.where(near[:, None], along / np.maximum(distance, 1e-9)[:, None], 0.0)
        for side in (slice(off, None), slice(None, -off)):
            total[side] += unit
            count[side] += near
    length = np.hypot(total[:, 0], total[:, 1])
    # Of a corner, the directions to the neighbours differ.
    flat = (count >= 2) & (length > 0.9 * count)
    normals[flat, 0] = -total[flat, 1] / length[flat]
    normals[flat, 1] = total[flat, 0] / length[flat]
    return normals


def deskewed(sweep: Sweep, twist: np.ndarray, sweep_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points and normals float64 [M, 2] in the lidar frame at the middle of the sweep.

    Args:
        sweep: the returns.
        twist: float64 [3] of the lidar in its own frame: m/s, m/s, rad/s.
        sweep_s: time from the first beam in the array to the last; negative: the last was measured first;
            0: all at once.
    """
    t = sweep.fraction * sweep_s
    yaw = twist[2] * t
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = sweep.points_m.T
    points = np.stack([c * x - s * y + twist[0] * t, s * x + c * y + twist[1] * t], axis=1)
    nx, ny = sweep.normals.T
    return points, np.stack([c * nx - s * ny, s * nx + c * ny], axis=1)


@dataclass(frozen=True)
class SweepAlignment:
    """Pose of a sweep relative to another, and how well they agree."""

    pose: np.ndarray  # float64 [3]: x, y (m), yaw (rad): pose_target_source
    residual_m: float  # mean distance to the target's lines, at most `RESIDUAL_CAP_M` each
    agreeing: float  # ratio of the points within 0.1 m of the target's lines


class Target:
    """A point cloud with normals that others are aligned to."""

    def __init__(self, points: np.ndarray, normals: np.ndarray) -> None:
        from scipy.spatial import cKDTree  # only where sweeps are compared: drivers start without SciPy

        self.known = np.hypot(normals[:, 0], normals[:, 1]) > 0.5
        self.points, self.normals = points[self.known], normals[self.known]
        self.tree = cKDTree(self.points) if len(self.points) else None

    def align(
        self, points: np.ndarray, guess: np.ndarray, gates_m: tuple[float, ...] = _GATES_M
    ) -> SweepAlignment | None:
        """Return the alignment of `points` [M, 2] from the pose `guess` [3]; None if too little overlaps.

        `gates_m`: largest distance of matched points, by iteration.
        """
        if self.tree is None or len(points) < MIN_POINTS:
            return None
        pose = guess.astype(np.float64).copy()
        for gate in gates_m:
            moved, distance, error, normals = self._match(points, pose)
            near = distance < gate
            if near.sum() < MIN_POINTS:
                return None
            weight = near / (1.0 + (error / (0.3 * gate)) ** 2) ** 2
            turned = moved - pose[:2]
            jacobian = np.column_stack([normals, normals[:, 1] * turned[:, 0] - normals[:, 0] * turned[:, 1]])
            A = (jacobian * weight[:, None]).T @ jacobian + np.diag([1e-3, 1e-3, 1e-3])
            step = np.linalg.solve(A, (jacobian * weight[:, None]).T @ error)
            pose -= step
            if gate == gates_m[-1] and float(np.abs(step).max()) < _CONVERGED:
                break
        _, distance, error, _ = self._match(points, pose)
        size = np.where(
            distance < 2.0 * RESIDUAL_CAP_M, np.minimum(np.abs(error), RESIDUAL_CAP_M), RESIDUAL_CAP_M
        )
        return SweepAlignment(pose, float(size.mean()), float((size < 0.1).mean()))

    def _match(self, points: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, ...]:
        c, s = math.cos(pose[2]), math.sin(pose[2])
        moved = points @ np.array([[c, s], [-s, c]]) + pose[:2]
        assert self.tree is not None
        distance, index = self.tree.query(moved)
        normals = self.normals[index]
        error = np.einsum("ij,ij->i", moved - self.points[index], normals)
        return moved, np.asarray(distance), error, normals


def compose(pose_a_b: np.ndarray, pose_b_c: np.ndarray) -> np.ndarray:
    """Return pose_a_c float64 [3] (x m, y m, yaw rad, not wrapped)."""
    c, s = math.cos(pose_a_b[2]), math.sin(pose_a_b[2])
    return np.array(
        [
            pose_a_b[0] + c * pose_b_c[0] - s * pose_b_c[1],
            pose_a_b[1] + s * pose_b_c[0] + c * pose_b_c[1],
            pose_a_b[2] + pose_b_c[2],
        ]
    )


def between(pose_a_b: np.ndarray, pose_a_c: np.ndarray) -> np.ndarray:
    """Return pose_b_c float64 [3]; the yaw is a difference, not wrapped."""
    c, s = math.cos(pose_a_b[2]), math.sin(pose_a_b[2])
    dx, dy = pose_a_c[0] - pose_a_b[0], pose_a_c[1] - pose_a_b[1]
    return np.array([c * dx + s * dy, -s * dx + c * dy, pose_a_c[2] - pose_a_b[2]])
