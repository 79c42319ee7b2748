"""`bench uncertainties`: stated standard deviations compared with true errors."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.geometry.trajectory import Trajectory, read_tum, write_tum
from beamsplat.common.geometry.transforms import se2_to_se3, se3_to_se2, so3_log
from beamsplat.services.fusion.calibration.motion import PARAMETERS
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.job_runner import JobRunner
from beamsplat.services.localization.lidar2d.motion_covariance import SPAN_NS
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam, ScanResult
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.source import open_source
from beamsplat.tools.bench.slam import recordings_in
from beamsplat.tools.evaluation.calibrate import calibrate_motion
from beamsplat.tools.evaluation.drive import open_drive

MOTION = ("motion in 1 s, forward", "motion in 1 s, left", "motion in 1 s, yaw")
_UNITS = {"clock_s": ("ms", 1e3), "x_m": ("mm", 1e3), "y_m": ("mm", 1e3)}
_ANGLE = ("deg", 180.0 / np.pi)
_TOLERANCE_NS = 20_000_000  # of the second between two poses


@dataclass(frozen=True)
class StatedErrors:
    """Errors of one quantity and the standard deviations that were stated for them, both float64 [N]."""

    errors: np.ndarray
    sigmas: np.ndarray

    def row(self, quantity: str, unit: str, scale: float) -> dict[str, Any]:
        """Return one row of the table; `scale` converts errors and sigmas to `unit`.

        The normalised error is the RMS of error / sigma. It is 1 for honest statements.
        """
        return {
            "quantity": quantity, "unit": unit, "samples": len(self.errors),
            "rms_error": scale * float(np.sqrt(np.mean(self.errors**2))),
            "mean_sigma": scale * float(np.mean(self.sigmas)),
            "normalised_error": float(np.sqrt(np.mean((self.errors / self.sigmas) ** 2))),
        }  # fmt: skip


def bench_uncertainties(folder: Path, log: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return a row for each stated uncertainty: samples, RMS error, mean sigma, normalised error.

    The motion over one second has a sample per scan; a calibration has one sample per recording and
    parameter, if the parameter is observable. Recordings with relations instead of a trajectory are left out:
    their truth is less accurate than the motion of one second.

    Args:
        folder: see `recordings_in`. The file camera.json beside a bag names the true mount of the camera and
            the offset of its clock; without the file the calibration in the bag counts as true.
        log: receives progress messages.
    """
    motion: list[tuple[np.ndarray, np.ndarray]] = []
    mounts: dict[str, list[tuple[float, float]]] = {name: [] for name in PARAMETERS}
    for name, bag, truth in recordings_in(folder):
        if truth[0] != "--groundtruth":
            log(f"{name}: left out, it has relations and no trajectory")
            continue
        log(f"{name} ...")
        results, trajectory, has_camera = map_recording(bag)
        motion.append(motion_samples(results, read_tum(Path(truth[1]))))
        if has_camera:
            for parameter, sample in _mount_samples(bag, trajectory).items():
                mounts[parameter].append(sample)
    rows = []
    if motion:
        errors, sigmas = (np.concatenate(parts) for parts in zip(*motion))
        for k, (quantity, unit) in enumerate(zip(MOTION, (("mm", 1e3), ("mm", 1e3), _ANGLE))):
            rows.append(StatedErrors(errors[:, k], sigmas[:, k]).row(quantity, *unit))
    for parameter, samples in mounts.items():
        if samples:
            quantity = f"camera {parameter.rsplit('_', 1)[0]}"
            rows.append(StatedErrors(*np.array(samples).T).row(quantity, *_UNITS.get(parameter, _ANGLE)))
    return rows


def map_recording(bag: Path) -> tuple[list[ScanResult], Trajectory, bool]:
    """Run the SLAM over a recording; return results, final trajectory, and whether there is a camera."""
    source = open_source(bag, SourceOptions(require=frozenset({"scan"})))
    try:
        measured = []
        has_camera = False
        for _, topic, message in source.messages():
            has_camera |= topic == "camera/image"
            if topic in ("wheel/odometry", "lidar/scan"):
                measured.append((message.stamp_ns, topic == "lidar/scan", message))
        found = source.rig()
    finally:
        source.close()
    rig = found if hasattr(found.lidar, "T_body_lidar") else found.message(0, str(bag))
    slam = LidarSlam(LidarSlamSettings(), rig.lidar.T_body_lidar)
    results = []
    with JobRunner(slam, threaded=True) as jobs:
        for stamp_ns, is_scan, m in sorted(measured, key=lambda item: item[:2]):
            if not is_scan:
                slam.add_odometry(stamp_ns, *(float(v) for v in se3_to_se2(m.T_odom_body)))
                continue
            jobs.before_scan()
            result = slam.add_scan(
                stamp_ns, m.ranges_m, m.angle_min_rad, m.angle_increment_rad, m.time_increment_s,
                m.range_min_m, m.range_max_m,
            )  # fmt: skip
            jobs.after_scan(result)
            results.append(result)
        jobs.finish()
    stamps_ns, pose_map_body, _ = slam.trajectory()
    return results, Trajectory(stamps_ns, se2_to_se3(pose_map_body)), has_camera


def motion_samples(results: list[ScanResult], truth: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return errors and sigmas [N, 3] of the motion over one second, as (forward m, left m, yaw rad)."""
    good = [r for r in results if r.status == "ok"]
    stamps_ns = np.array([r.stamp_ns for r in good], dtype=np.int64)
    errors, sigmas = [], []
    for result in good:
        before = int(np.searchsorted(stamps_ns, result.stamp_ns - SPAN_NS - _TOLERANCE_NS))
        if abs(stamps_ns[before] - (result.stamp_ns - SPAN_NS)) > _TOLERANCE_NS:
            continue
        T_a, T_b = truth.at(int(stamps_ns[before])), truth.at(result.stamp_ns)
        if T_a is None or T_b is None:
            continue
        true_motion = se2.between(np.array(se3_to_se2(T_a)), np.array(se3_to_se2(T_b)))
        motion = se2.between(good[before].pose_odom_body, result.pose_odom_body)
        errors.append(se2.between(true_motion, motion))
        c, s = np.cos(result.pose_odom_body[2]), np.sin(result.pose_odom_body[2])
        R_body_odom = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        sigmas.append(np.sqrt(np.diag(R_body_odom @ result.covariance @ R_body_odom.T)))
    return np.array(errors).reshape(-1, 3), np.array(sigmas).reshape(-1, 3)


def _mount_samples(bag: Path, trajectory: Trajectory) -> dict[str, tuple[float, float]]:
    """Return (error, sigma) of each observable parameter of `PARAMETERS`, in its unit there."""
    with tempfile.TemporaryDirectory() as folder:
        poses = Path(folder) / "trajectory.tum"
        write_tum(poses, trajectory, "T_map_body")
        drive = open_drive(bag, poses)
    found = calibrate_motion(drive)
    true_values = np.zeros(len(PARAMETERS))
    description = bag.parent / "camera.json"
    if description.is_file():
        text = json.loads(description.read_text())
        T_true = np.array(text.get("T_base_camera", {}).get("matrix", drive.T_body_camera))
        true_values[0] = -1e-3 * text.get("camera_clock_offset_ms", 0.0)
        true_values[1:4] = so3_log(T_true[:3, :3] @ drive.T_body_camera[:3, :3].T)
        true_values[4:6] = (T_true - drive.T_body_camera)[:2, 3]
    return {
        name: (float(value - true), float(sigma))
        for name, value, true, sigma, sure in zip(
            PARAMETERS, found.values, true_values, found.sigma, found.observable
        )
        if sure
    }
