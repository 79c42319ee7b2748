"""Measurements of a recording for the lidar SLAM, and errors of its trajectories against the truth."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.trajectory import read_tum
from beamsplat.common.geometry.transforms import se3_to_se2
from beamsplat.services.localization.lidar2d.metrics import interpolate_poses, trajectory_errors


def measurements(source: Any) -> Iterator[tuple]:
    """Yield the scans and odometry of a recording in its order, as the tuples of `MeasurementLog`."""
    for _, topic, m in source.messages():
        if topic == "lidar/scan":
            yield (
                "scan", m.stamp_ns, m.ranges_m, m.angle_min_rad, m.angle_increment_rad, m.time_increment_s,
                m.range_min_m, m.range_max_m,
            )  # fmt: skip
        elif topic == "wheel/odometry":
            x_m, y_m, yaw_rad = se3_to_se2(m.T_odom_body)
            yield "odometry", m.stamp_ns, float(x_m), float(y_m), float(yaw_rad)


def planar_poses(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps int64 [N] and planar poses float64 [N, 3] of a TUM file."""
    trajectory = read_tum(path)
    return trajectory.stamps_ns, se3_to_se2(trajectory.T_a_b)


def errors_against_truth(folder: Path, truth: Path) -> dict[str, Any]:
    """Return the errors of the optimised and, with prefix `online_`, of the online trajectory.

    Args:
        folder: as `map_measurements` writes it, or one trajectory (TUM file).
        truth: TUM file of the true body poses.

    Raises:
        UserError: no pose is in the time range of the truth.
    """
    figures: dict[str, Any] = {}
    true_stamps_ns, pose_world_body = planar_poses(truth)
    names = {"": "trajectory.tum", "online_": "online.tum"}
    if folder.is_file():
        folder, names = folder.parent, {"": folder.name}
    elif not (folder / names["online_"]).is_file():
        del names["online_"]
    for prefix, name in names.items():
        stamps_ns, pose_map_body = planar_poses(folder / name)
        inside = (stamps_ns >= true_stamps_ns[0]) & (stamps_ns <= true_stamps_ns[-1])
        if not inside.any():
            raise UserError(f"{truth}: has no pose in the time range of {folder / name}")
        true_pose_world_body = interpolate_poses(true_stamps_ns, pose_world_body, stamps_ns[inside])
        errors = trajectory_errors(pose_map_body[inside], true_pose_world_body)
        figures |= {
            f"{prefix}poses": errors.poses,
            f"{prefix}ate_first_pose_rmse_m": errors.ate_first_pose_rmse_m,
            f"{prefix}ate_se3_rmse_m": errors.ate_se3_rmse_m,
            f"{prefix}yaw_rmse_rad": errors.yaw_rmse_rad,
        }
    return figures
