"""`bench uncertainties`: stated standard deviations compared with true errors."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.geometry.trajectory import Trajectory, read_tum, write_tum
from beamsplat.common.geometry.transforms import se2_to_se3, se3_to_se2, so3_log
from beamsplat.services.fusion.calibration.motion import PARAMETERS, apply_correction
from beamsplat.services.fusion.calibration.startup_check import CalibrationHealth, StartupCheck
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.job_runner import JobRunner
from beamsplat.services.localization.lidar2d.motion_covariance import SPAN_NS
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam, ScanResult
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.source import open_source
from beamsplat.tools.bench.depth_uncertainties import BANDS_M, DEPTHS, depth_samples
from beamsplat.tools.bench.slam import recordings_in
from beamsplat.tools.evaluation.calibrate import calibrate_motion, with_clock_offset
from beamsplat.tools.evaluation.drive import RecordedDrive, open_drive

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
    parameter, if the parameter is observable; depth has a sample per pixel of a grid, if the recording has
    true depth. Depth is fused with the true calibration, because its sigma does not include a wrong one.
    Recordings with relations instead of a trajectory are left out: their truth is less accurate than the
    motion of one second.

    Args:
        folder: see `recordings_in`. The file camera.json beside a bag names the true mount of the camera and
            the offset of its clock; without the file the calibration in the bag counts as true.
        log: receives progress messages.
    """
    motion: list[tuple[np.ndarray, np.ndarray]] = []
    calibrations: dict[str, list[tuple[float, float]]] = {}
    depths: dict[str, list[np.ndarray]] = {}
    for name, bag, truth in recordings_in(folder):
        if truth[0] != "--groundtruth":
            log(f"{name}: left out, it has relations and no trajectory")
            continue
        log(f"{name} ...")
        results, trajectory, has_camera = map_recording(bag)
        motion.append(motion_samples(results, read_tum(Path(truth[1]))))
        if not has_camera:
            continue
        drive = _open_drive(bag, trajectory)
        true_values = _true_corrections(bag, drive)
        for check, samples in (
            ("camera", _mount_samples(drive, true_values)),
            ("start-up check,", _startup_samples(drive, results, true_values)),
        ):
            for parameter, sample in samples.items():
                calibrations.setdefault(f"{check} {parameter}", []).append(sample)
        if (bag.parent / "depth_gt").is_dir():
            offset_ns = round(true_values[0] * 1e9)
            right = replace(
                with_clock_offset(drive, offset_ns),
                poses=_odom(results), T_body_camera=apply_correction(drive.T_body_camera, true_values),
            )  # fmt: skip
            for method, rows in depth_samples(right, bag.parent, offset_ns).items():
                depths.setdefault(method, []).append(rows)
    table = []
    if motion:
        errors, sigmas = (np.concatenate(parts) for parts in zip(*motion))
        for k, (quantity, unit) in enumerate(zip(MOTION, (("mm", 1e3), ("mm", 1e3), _ANGLE))):
            table.append(StatedErrors(errors[:, k], sigmas[:, k]).row(quantity, *unit))
    for quantity, pairs in calibrations.items():
        name, parameter = quantity.rsplit(" ", 1)
        unit = _UNITS.get(parameter, _ANGLE)
        stated = StatedErrors(*np.array(pairs).T)
        table.append(stated.row(f"{name} {parameter.rsplit('_', 1)[0]}", *unit))
    for method, groups in depths.items():
        rows = np.concatenate(groups)
        for nearest, farthest in BANDS_M:
            chosen = rows[(rows[:, 0] >= nearest) & (rows[:, 0] < farthest)]
            if len(chosen):
                quantity = f"{DEPTHS[method]}, {nearest:g} to {farthest:g} m"
                table.append(StatedErrors(chosen[:, 1], chosen[:, 2]).row(quantity, "mm", 1e3))
    return table


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


def _odom(results: list[ScanResult]) -> Trajectory:
    good = [r for r in results if r.status == "ok"]
    stamps_ns = np.array([r.stamp_ns for r in good], dtype=np.int64)
    return Trajectory(stamps_ns, se2_to_se3(np.array([r.pose_odom_body for r in good])))


def _open_drive(bag: Path, trajectory: Trajectory) -> RecordedDrive:
    with tempfile.TemporaryDirectory() as folder:
        poses = Path(folder) / "trajectory.tum"
        write_tum(poses, trajectory, "T_map_body")
        return open_drive(bag, poses)


def _true_corrections(bag: Path, drive: RecordedDrive) -> np.ndarray:
    """Return the true corrections float64 [6] of the calibration in the bag, as `PARAMETERS`."""
    true_values = np.zeros(len(PARAMETERS))
    description = bag.parent / "camera.json"
    if description.is_file():
        text = json.loads(description.read_text())
        T_true = np.array(text.get("T_base_camera", {}).get("matrix", drive.T_body_camera))
        true_values[0] = -1e-3 * text.get("camera_clock_offset_ms", 0.0)
        true_values[1:4] = so3_log(T_true[:3, :3] @ drive.T_body_camera[:3, :3].T)
        true_values[4:6] = (T_true - drive.T_body_camera)[:2, 3]
    return true_values


def _mount_samples(drive: RecordedDrive, true_values: np.ndarray) -> dict[str, tuple[float, float]]:
    """Return (error, sigma) of each observable parameter of `PARAMETERS`, in its unit there."""
    found = calibrate_motion(drive)
    return {
        name: (float(value - true), float(sigma))
        for name, value, true, sigma, sure in zip(
            PARAMETERS, found.values, true_values, found.sigma, found.observable
        )
        if sure
    }


def _startup_samples(
    drive: RecordedDrive, results: list[ScanResult], true_values: np.ndarray
) -> dict[str, tuple[float, float]]:
    """Return (error, sigma) of each parameter that the check at the start observes, as `_mount_samples`."""
    health = _startup_health(drive, results)
    if health is None:
        return {}
    values = np.array([1e-3 * health.clock_ms, *np.radians(health.turn_deg)])
    sigmas = np.array([1e-3 * health.clock_sigma_ms, *np.radians(health.turn_sigma_deg)])
    return {
        name: (float(value - true), float(sigma))
        for name, value, true, sigma in zip(PARAMETERS[:4], values, true_values[:4], sigmas)
        if np.isfinite(value)
    }


def _startup_health(drive: RecordedDrive, results: list[ScanResult]) -> CalibrationHealth | None:
    """Run the check at the start on the poses in odom; None if the drive is too short for it."""
    check = StartupCheck(drive.undistort.pinhole, drive.T_body_camera, drive.T_body_lidar)
    odom = _odom(results)
    number = 0
    for stamp_ns, T_odom_body in zip(odom.stamps_ns.tolist(), odom.T_a_b):
        check.add_pose(stamp_ns, T_odom_body)
        job = check.job()
        if job is not None:
            return job()
        while number < len(drive.images) and drive.images[number].stamp_ns <= stamp_ns:
            T_image = odom.at(drive.images[number].stamp_ns)
            if T_image is not None:
                check.add_image(drive.images[number].stamp_ns, drive.rgb(number), T_image)
            number += 1
    return None
