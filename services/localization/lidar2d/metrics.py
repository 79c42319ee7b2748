"""Accuracy metrics of planar trajectories: relations (Kuemmerle et al. 2009), ATE and yaw RMSE."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beamsplat.services.localization.lidar2d import se2

NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class RelationErrors:
    """Mean and standard deviation of the absolute errors of relative poses, over all relations."""

    relations: int
    skipped: int  # relations without an estimated pose at one of their stamps
    translation_mean_m: float
    translation_std_m: float
    rotation_mean_deg: float
    rotation_std_deg: float


@dataclass(frozen=True)
class TrajectoryErrors:
    """Absolute trajectory errors (RMSE), after an alignment without scale."""

    poses: int
    ate_first_pose_rmse_m: float
    ate_se3_rmse_m: float
    yaw_rmse_rad: float


def read_relations(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps int64 [R, 2] (ns) and relative poses float64 [R, 3] of a `.relations` file.

    Format of Kuemmerle et al. 2009: t1 t2 x y z roll pitch yaw, the pose of t2 in the frame of t1. Raises
    ValueError with the line number.
    """
    stamps, relative = [], []
    for number, line in enumerate(Path(path).read_text().splitlines(), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) != 8:
            raise ValueError(
                f"{path}:{number}: {len(fields)} columns, expected 8: t1 t2 x y z roll pitch yaw"
            )
        try:
            stamps.append([stamp_ns_of(fields[0]), stamp_ns_of(fields[1])])
            relative.append([float(fields[2]), float(fields[3]), float(fields[7])])
        except ValueError as error:
            raise ValueError(f"{path}:{number}: {error}") from error
    return np.array(stamps, dtype=np.int64).reshape(-1, 2), np.array(relative).reshape(-1, 3)


def stamp_ns_of(seconds: str) -> int:
    """Convert decimal seconds as text to ns, exactly; a float has a resolution of only about 100 ns.

    Raises ValueError if the text is not a decimal number.
    """
    whole, _, fraction = seconds.partition(".")
    if not (whole.lstrip("-").isdigit() and (fraction == "" or fraction.isdigit())):
        raise ValueError(f"stamp {seconds!r} is not decimal seconds")
    sign = -1 if whole.startswith("-") else 1
    return int(whole) * NS_PER_S + sign * int(fraction[:9].ljust(9, "0") or "0")


def relation_errors(
    stamps_ns: np.ndarray,  # int64 [N], increasing
    pose_map_body: np.ndarray,  # float64 [N, 3]
    relation_stamps_ns: np.ndarray,  # int64 [R, 2]
    relations: np.ndarray,  # float64 [R, 3]
    pose_body_reference: np.ndarray | None = None,  # float64 [3], the frame of the relations
    tolerance_ns: int = 1_000_000,
) -> RelationErrors:
    """Compare estimated relative poses with the relations: length of translation error, absolute yaw error.

    Raises ValueError if no relation has both stamps in the trajectory.
    """
    poses = (
        pose_map_body if pose_body_reference is None else se2.compose_many(pose_map_body, pose_body_reference)
    )
    index, ok = nearest_stamps(stamps_ns, relation_stamps_ns.ravel(), tolerance_ns)
    index, both = index.reshape(-1, 2), ok.reshape(-1, 2)
    ok = both[:, 0] & both[:, 1]
    if not ok.any():
        raise ValueError(
            "no relation has both its stamps in the trajectory; check that both are of the same log"
        )
    estimated = se2.between_many(poses[index[ok, 0]], poses[index[ok, 1]])
    difference = se2.between_many(relations[ok], estimated)
    translation = np.hypot(difference[:, 0], difference[:, 1])
    rotation = np.degrees(np.abs(difference[:, 2]))
    return RelationErrors(
        int(ok.sum()),
        int((~ok).sum()),
        float(translation.mean()),
        float(translation.std()),
        float(rotation.mean()),
        float(rotation.std()),
    )


def trajectory_errors(
    pose_map_body: np.ndarray,  # float64 [N, 3], estimated
    pose_world_body: np.ndarray,  # float64 [N, 3], truth at the same stamps
) -> TrajectoryErrors:
    """Return the ATE aligned by the first pose, the ATE after the best rigid alignment, and the yaw RMSE.

    The yaw errors use the alignment by the first pose. Raises ValueError for unequal or empty inputs.
    """
    if pose_map_body.shape != pose_world_body.shape or len(pose_map_body) == 0:
        raise ValueError(
            f"estimate {pose_map_body.shape} and truth {pose_world_body.shape} must be equal [N > 0, 3]"
        )
    pose_world_map = se2.compose(pose_world_body[0], se2.inverse(pose_map_body[0]))
    aligned = se2.compose_many(pose_world_map, pose_map_body)
    first = np.hypot(*(aligned[:, :2] - pose_world_body[:, :2]).T)
    yaw = se2.wrap_many(aligned[:, 2] - pose_world_body[:, 2])
    best = se2.transform(rigid_alignment(pose_map_body[:, :2], pose_world_body[:, :2]), pose_map_body[:, :2])
    rigid = np.hypot(*(best - pose_world_body[:, :2]).T)
    return TrajectoryErrors(len(first), _rms(first), _rms(rigid), _rms(yaw))


def rigid_alignment(points_a: np.ndarray, points_b: np.ndarray) -> np.ndarray:
    """Return pose_b_a that minimises the squared distances of point pairs [N, 2] (Umeyama without scale)."""
    a, b = points_a - points_a.mean(axis=0), points_b - points_b.mean(axis=0)
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    shift = points_b.mean(axis=0) - se2.transform(np.array([0.0, 0.0, yaw]), points_a.mean(axis=0)[None])[0]
    return np.array([shift[0], shift[1], yaw])


def interpolate_poses(
    stamps_ns: np.ndarray,  # int64 [N], increasing
    poses: np.ndarray,  # float64 [N, 3]
    at_ns: np.ndarray,  # int64 [M]
) -> np.ndarray:
    """Interpolate poses at the stamps `at_ns`, linear in position and yaw; the end poses are used beyond."""
    base = int(stamps_ns[0])
    t, q = (stamps_ns - base) * 1e-9, (at_ns - base) * 1e-9
    yaw = np.unwrap(poses[:, 2])
    columns = [
        np.interp(q, t, poses[:, 0]),
        np.interp(q, t, poses[:, 1]),
        se2.wrap_many(np.interp(q, t, yaw)),
    ]
    return np.stack(columns, axis=1)


def nearest_stamps(
    stamps_ns: np.ndarray, wanted_ns: np.ndarray, tolerance_ns: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return for each of `wanted_ns` the index of the nearest stamp, and if it is within the tolerance."""
    if len(stamps_ns) == 0:
        return np.zeros(len(wanted_ns), dtype=np.int64), np.zeros(len(wanted_ns), dtype=bool)
    right = np.clip(np.searchsorted(stamps_ns, wanted_ns), 0, len(stamps_ns) - 1)
    left = np.maximum(right - 1, 0)
    closer_left = np.abs(stamps_ns[left] - wanted_ns) <= np.abs(stamps_ns[right] - wanted_ns)
    index = np.where(closer_left, left, right)
    return index, np.abs(stamps_ns[index] - wanted_ns) <= tolerance_ns


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
