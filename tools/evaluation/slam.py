"""Read measurements for the lidar SLAM from a recording; compute errors against a true trajectory."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.trajectory import read_tum
from beamsplat.common.geometry.transforms import se3_to_se2
from beamsplat.services.localization.lidar2d.metrics import interpolate_poses, trajectory_errors
from beamsplat.tools.evaluation.loops import loop_figures

COSTS = (
    "cpu_ms_per_scan", "cpu_ms_per_scan_first_tenth", "cpu_ms_per_scan_last_tenth", "step_p95_ms",
    "step_max_ms", "step_max_cpu_ms", "peak_rss_mb",
)  # fmt: skip


def measurements(source: Any) -> Iterator[tuple]:
    """Yield scans and wheel odometry in the order of a recording, as tuples for `MeasurementLog`.

    `source` is the result of `open_source`.
    """
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
    """Return stamps int64 [N] in ns and planar poses float64 [N, 3] (x m, y m, yaw rad) of a TUM file."""
    trajectory = read_tum(path)
    return trajectory.stamps_ns, se3_to_se2(trajectory.T_a_b)


def costs(folder: Path) -> dict[str, float]:
    """Return what `map_measurements` measured of its CPU time, steps and memory, by name; {} without a file.

    `folder` is its output folder.
    """
    path = folder / "figures.json"
    if not path.is_file():
        return {}
    figures = json.loads(path.read_text())
    return {name: figures[name] for name in COSTS if name in figures}


def errors_against_truth(folder: Path, truth: Path) -> dict[str, Any]:
    """Return position errors (m) and yaw errors (rad) of estimated trajectories against the truth, by name.

    Names with the prefix `online_` are of the trajectory as published during the drive, the others of the
    trajectory after the last optimisation. For the latter, see also `loops.loop_figures`.

    Args:
        folder: output folder of `map_measurements`, or one trajectory (TUM file).
        truth: TUM file of the true body poses.

    Raises:
        UserError: no estimated pose is in the time range of the true trajectory.
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
        if not prefix:
            state = folder / "state" if name == "trajectory.tum" and (folder / "state").is_dir() else None
            figures |= loop_figures(
                state, true_stamps_ns, pose_world_body, stamps_ns[inside], pose_map_body[inside]
            )
    return figures
