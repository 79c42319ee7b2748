"""Faults planted in a recorded drive, and what the check at the start says about each: `bench diagnosis`.

Each fault is planted in the messages (images, scans, stamps) or in the calibration, then the lidar SLAM runs
on the scans and odometry, and the check sees what it would see on the robot.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.geometry.beams import scan_points
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.sensor_history import TimedScan
from beamsplat.common.geometry.trajectory import Trajectory, read_tum
from beamsplat.common.geometry.transforms import make_transform, se2_to_se3, se3_to_se2, so3_exp
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.services.fusion.calibration.startup_check import CalibrationHealth, StartupCheck
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.source import open_source

_POSE_GAP_NS = 1_000_000_000


@dataclass(frozen=True)
class CheckedDrive:
    """A part of a drive as the robot would see it, in memory."""

    images: list[tuple[int, np.ndarray]]  # (stamp ns, RGB uint8 [H, W, 3] as the camera publishes it)
    scans: list[TimedScan]
    odometry: list[tuple[str, int, float, float, float]]
    camera: Pinhole
    T_body_camera: np.ndarray
    T_body_lidar: np.ndarray


@dataclass(frozen=True)
class PlantedFault:
    """A fault: its name, the cause that the check has to name (`CalibrationHealth.cause`), and the change."""

    name: str
    cause: str
    plant: Callable[[CheckedDrive], CheckedDrive]


@dataclass(frozen=True)
class Diagnosis:
    """What the check said about a planted fault."""

    fault: PlantedFault
    health: CalibrationHealth | None  # None = the check did not get enough data

    @property
    def right(self) -> bool:
        return self.health is not None and self.health.cause == self.fault.cause


def read_drive(path: Path, start_s: float, duration_s: float) -> CheckedDrive:
    """Return a part of a recording.

    Raises:
        UserError: the recording has no images, scans or calibration.
    """
    source = open_source(path, SourceOptions(require=frozenset({"scan", "image"})))
    images, scans, wheels = [], [], []
    try:
        rig = source.rig()
        begin_ns = source.start_ns + round(start_s * 1e9)
        for _, topic, m in source.messages(begin_ns, begin_ns + round(duration_s * 1e9)):
            if topic == "camera/image":
                rgb = decode_rgb(m.data, m.encoding, m.width_px, m.height_px, m.step_bytes)
                images.append((m.stamp_ns, rgb))
            elif topic == "lidar/scan":
                scans.append(TimedScan.of(m))
            elif topic == "wheel/odometry":
                x_m, y_m, yaw_rad = se3_to_se2(m.T_odom_body)
                wheels.append(("odometry", m.stamp_ns, float(x_m), float(y_m), float(yaw_rad)))
    finally:
        source.close()
    camera = Pinhole.of(rig.camera)
    return CheckedDrive(images, scans, wheels, camera, rig.camera.T_body_camera, rig.lidar.T_body_lidar)


def diagnose(drive: CheckedDrive) -> CalibrationHealth | None:
    """Return the result of the check on a drive, with poses of the lidar SLAM as published meanwhile."""
    poses = _online_poses(drive)
    undistort = Undistorter(drive.camera)
    check = StartupCheck(undistort.pinhole, drive.T_body_camera, drive.T_body_lidar)
    for stamp_ns, T_map_body in zip(poses.stamps_ns.tolist(), poses.T_a_b):
        check.add_pose(stamp_ns, T_map_body)
    for _, stamp_ns, x_m, y_m, yaw_rad in drive.odometry:
        check.add_wheels(stamp_ns, se2_to_se3(np.array([x_m, y_m, yaw_rad])))
    for scan in drive.scans:
        pose = poses.at(scan.middle_ns, max_gap_ns=_POSE_GAP_NS, max_extrapolation_ns=0)
        if pose is not None:
            points, _ = scan_points(
                scan.ranges_m, scan.angle_min_rad, scan.angle_increment_rad, scan.range_min_m,
                scan.range_max_m,
            )  # fmt: skip
            check.add_scan(points, pose)
    for stamp_ns, rgb in drive.images:
        pose = poses.at(stamp_ns, max_gap_ns=_POSE_GAP_NS, max_extrapolation_ns=0)
        if pose is not None:
            check.add_image(stamp_ns, undistort(rgb), pose)
            if (job := check.job()) is not None:
                return job()
    return None


def bench_diagnosis(
    path: Path, start_s: float = 0.0, duration_s: float = 40.0, report: Callable[[str], None] = lambda _: None
) -> Iterator[Diagnosis]:
    """Yield the diagnosis of a drive without a fault, then of each planted fault."""
    drive = read_drive(path, start_s, duration_s)
    for fault in FAULTS:
        found = Diagnosis(fault, diagnose(fault.plant(drive)))
        status = found.health.status if found.health is not None else "not enough data"
        report(f"{'right' if found.right else 'WRONG'}  {fault.name}: {status}")
        yield found


def _online_poses(drive: CheckedDrive) -> Trajectory:
    """Return `T_map_body` of the lidar SLAM as it is published during the drive."""
    from beamsplat.services.localization.lidar2d.offline_mapping import MeasurementLog, map_measurements

    measured = [
        ("scan", s.stamp_ns, s.ranges_m, s.angle_min_rad, s.angle_increment_rad, s.time_increment_s,
         s.range_min_m, s.range_max_m)
        for s in drive.scans
    ]  # fmt: skip
    merged = sorted([*drive.odometry, *measured], key=lambda measurement: measurement[1])
    with tempfile.TemporaryDirectory() as folder:
        map_measurements(MeasurementLog(drive.T_body_lidar, merged, lambda: None), Path(folder))
        return read_tum(Path(folder) / "online.tum")


def _each_image(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[CheckedDrive], CheckedDrive]:
    def plant(drive: CheckedDrive) -> CheckedDrive:
        return replace(drive, images=[(stamp, change(rgb)) for stamp, rgb in drive.images])

    return plant


def _cropped(drive: CheckedDrive) -> CheckedDrive:
    """Crop the images as a region of interest off the centre does; K remains that of the whole sensor."""
    h, w = drive.camera.shape
    x, y, width, height = w * 3 // 16, h * 11 // 60, w * 5 // 8, h * 19 // 30
    camera = replace(drive.camera, width_px=width, height_px=height)
    images = [
        (stamp, np.ascontiguousarray(rgb[y : y + height, x : x + width])) for stamp, rgb in drive.images
    ]
    return replace(drive, images=images, camera=camera)


def _distorted(drive: CheckedDrive) -> CheckedDrive:
    """Bend the images as a usual wide-angle lens does (k1 = -0.28, k2 = 0.08), and state no distortion."""
    h, w = drive.camera.shape
    lens = replace(drive.camera, distortion_model="plumb_bob", distortion=(-0.28, 0.08, 0.0, 0.0, 0.0))
    v, u = np.mgrid[:h, :w].astype(np.float64)
    rays = lens.rays(np.stack([u.ravel(), v.ravel()], axis=1))
    map_uv = (rays[:, :2] * [lens.fx_px, lens.fy_px] + [lens.cx_px, lens.cy_px]).astype(np.float32)
    map_u, map_v = np.moveaxis(map_uv.reshape(h, w, 2), 2, 0)
    return _each_image(
        lambda rgb: cv2.remap(rgb, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    )(drive)


def _other_size(drive: CheckedDrive) -> CheckedDrive:
    """State K of images with three quarters of the size."""
    c = drive.camera
    k = 0.75
    return replace(drive, camera=replace(
        c, fx_px=k * c.fx_px, fy_px=k * c.fy_px, cx_px=k * (c.cx_px + 0.5) - 0.5,
        cy_px=k * (c.cy_px + 0.5) - 0.5,
    ))  # fmt: skip


def _focal(drive: CheckedDrive) -> CheckedDrive:
    """State a focal length of another lens: 1.3 times the true one."""
    return replace(drive, camera=replace(
        drive.camera, fx_px=1.3 * drive.camera.fx_px, fy_px=1.3 * drive.camera.fy_px
    ))  # fmt: skip


def _late(drive: CheckedDrive) -> CheckedDrive:
    return replace(drive, images=[(stamp + 150_000_000, rgb) for stamp, rgb in drive.images])


def _turned_camera(roll: float, pitch: float, yaw: float) -> Callable[[CheckedDrive], CheckedDrive]:
    """State a mount of the camera that is turned by these angles (degrees) about the body axes."""
    R = so3_exp(np.array([0.0, 0.0, np.radians(yaw)])) @ so3_exp(np.array([0.0, np.radians(pitch), 0.0]))
    R = R @ so3_exp(np.array([np.radians(roll), 0.0, 0.0]))

    def plant(drive: CheckedDrive) -> CheckedDrive:
        T = drive.T_body_camera.copy()
        T[:3, :3] = R @ T[:3, :3]
        return replace(drive, T_body_camera=T)

    return plant


def _housing_frame(drive: CheckedDrive) -> CheckedDrive:
    """State the mount of the housing (x forward) as that of the optical frame."""
    T = make_transform(np.eye(3), drive.T_body_camera[:3, 3])
    return replace(drive, T_body_camera=T)


def _mirrored_lidar(drive: CheckedDrive) -> CheckedDrive:
    """Count the angles of the lidar the other way, as a lidar mounted upside down does."""
    scans = [
        replace(s, angle_min_rad=-s.angle_min_rad, angle_increment_rad=-s.angle_increment_rad)
        for s in drive.scans
    ]
    return replace(drive, scans=scans)


def _turned_lidar(drive: CheckedDrive) -> CheckedDrive:
    scans = [replace(s, angle_min_rad=s.angle_min_rad + np.pi) for s in drive.scans]
    return replace(drive, scans=scans)


FAULTS = (
    PlantedFault("no fault", "ok", lambda drive: drive),
    PlantedFault("images upside down", "images upside down", _each_image(lambda rgb: rgb[::-1, ::-1].copy())),
    PlantedFault("images mirrored", "images mirrored", _each_image(lambda rgb: rgb[:, ::-1].copy())),
    PlantedFault("region of interest, K of the whole sensor", "principal point", _cropped),
    PlantedFault("distortion missing", "distortion", _distorted),
    PlantedFault("K of a smaller image", "K of another size", _other_size),
    PlantedFault("focal length 1.3 times", "K", _focal),
    PlantedFault("images 150 ms late", "clock", _late),
    PlantedFault("camera yaw wrong by 5 degrees", "mount", _turned_camera(0.0, 0.0, 5.0)),
    PlantedFault("camera pitch wrong by 4 degrees", "mount", _turned_camera(0.0, 4.0, 0.0)),
    PlantedFault("camera mount without the optical rotation", "optical frame", _housing_frame),
    PlantedFault("lidar upside down", "lidar mirrored", _mirrored_lidar),
    PlantedFault("lidar turned by 180 degrees", "lidar turned", _turned_lidar),
)
