"""Load a recorded drive for evaluation and calibration: images, scans, poses, calibration."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import NO_BEAMS, Beams, deskew_beams, scan_points
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.sensor_history import TimedScan
from beamsplat.common.geometry.trajectory import Trajectory, read_tum
from beamsplat.common.geometry.transforms import se3_to_se2, transform_points
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.source import open_source

_MAX_EXTRAPOLATION_NS = 200_000_000  # poses are extrapolated this far beyond the trajectory


@dataclass
class RecordedDrive:
    """A recorded drive: images, scans, poses and calibration. Images are decoded only when they are used."""

    path: Path
    camera: Pinhole
    T_body_camera: np.ndarray
    T_body_lidar: np.ndarray
    images: list[Any]  # messages Image, by stamp
    scans: list[TimedScan]
    poses: Trajectory
    poses_name: str
    undistort: Undistorter = field(init=False)

    def __post_init__(self) -> None:
        self.undistort = Undistorter(self.camera)
        self._middles = np.array([scan.middle_ns for scan in self.scans], dtype=np.int64)

    @property
    def planar(self) -> bool:
        """Whether the body stays on a level floor: heights within 3 cm, every tilt below 2 degrees."""
        T = self.poses.T_a_b
        level = bool(np.all(T[:, 2, 2] > np.cos(np.radians(2.0))))
        return level and float(np.ptp(T[:, 2, 3])) < 0.03

    def pose(self, stamp_ns: int) -> np.ndarray | None:
        """Return `T_map_body` float64 [4, 4] at a time, interpolated.

        None in gaps of more than 1 s between poses, and more than 0.2 s before the first or after the last.
        """
        return self.poses.at(stamp_ns, max_gap_ns=1_000_000_000, max_extrapolation_ns=_MAX_EXTRAPOLATION_NS)

    def rgb(self, index: int) -> np.ndarray:
        """Return image `index`, undistorted, RGB uint8 [H, W, 3].

        Raises:
            UserError: the image cannot be decoded, or has another size than the calibration.
        """
        image = self.images[index]
        try:
            return self.undistort(
                decode_rgb(image.data, image.encoding, image.width_px, image.height_px, image.step_bytes)
            )
        except ValueError as error:
            raise UserError(f"{self.path}: the image at {image.stamp_ns} ns: {error}") from error

    def scan_near(self, stamp_ns: int) -> TimedScan | None:
        """Return the scan whose middle is nearest to a time; None if the difference is 0.15 s or more."""
        if len(self.scans) == 0:
            return None
        i = int(np.argmin(np.abs(self._middles - stamp_ns)))
        return self.scans[i] if abs(int(self._middles[i]) - stamp_ns) < 150_000_000 else None

    def beams_at(self, stamp_ns: int, excluded: np.ndarray | None = None) -> Beams:
        """Return the beams of the nearest scan, deskewed, in the body frame at time `stamp_ns`.

        Beams whose flag in `excluded` bool [beams] is True are left out. No beams if a pose is unknown.
        """
        scan = self.scan_near(stamp_ns)
        return NO_BEAMS if scan is None else self.beams_of(scan, stamp_ns, excluded)

    def beams_of(self, scan: TimedScan, stamp_ns: int, excluded: np.ndarray | None = None) -> Beams:
        """Return the beams of a scan, deskewed, in the body frame at time `stamp_ns`.

        Beams whose flag in `excluded` bool [beams] is True are left out. No beams if a pose is unknown.
        """
        points, index = scan_points(
            scan.ranges_m, scan.angle_min_rad, scan.angle_increment_rad, scan.range_min_m, scan.range_max_m
        )
        if excluded is not None:
            keep = ~excluded[index]
            points, index = points[keep], index[keep]
        first, last, then = self.pose(scan.stamp_ns), self.pose(scan.last_ns), self.pose(stamp_ns)
        if first is None or last is None or then is None:
            return NO_BEAMS
        fraction = index / max(len(scan.ranges_m) - 1, 1)
        moved = deskew_beams(points, fraction, first, last, then, self.T_body_lidar)
        return Beams(moved, index, np.full(len(index), 0.01))

    def scan_in_map(self, scan: TimedScan, excluded: np.ndarray | None = None) -> np.ndarray:
        """Return the points float64 [N, 3] of a scan in the map frame; [0, 3] if a pose is unknown.

        Beams whose flag in `excluded` bool [beams] is True are left out.
        """
        T_map_body = self.pose(scan.middle_ns)
        if T_map_body is None:
            return np.zeros((0, 3))
        return transform_points(T_map_body, self.beams_of(scan, scan.middle_ns, excluded).points_body_m)


def open_drive(
    path: Path, poses: Path | None = None, rig: Path | None = None, topics: dict[str, Any] | None = None
) -> RecordedDrive:
    """Open a recording: a bag, or a folder that contains bag/.

    Poses are taken from the TUM file `poses` (T_map_body), else from the pose topic of the recording, else
    from the lidar SLAM, which is run on it. `topics`: options of `SourceOptions`, for example `scan_topic`.

    Raises:
        UserError: images, scans, calibration or poses are missing.
    """
    source = open_source(path, SourceOptions(rig=rig, require=frozenset({"scan", "image"}), **(topics or {})))
    try:
        images, scans, stamps, T, wheels = [], [], [], [], []
        for _, topic, message in source.messages():
            if topic == "camera/image":
                images.append(message)
            elif topic == "lidar/scan":
                scans.append(TimedScan.of(message))
            elif topic == "external/pose":
                stamps.append(message.stamp_ns)
                T.append(message.T_map_body)
            elif topic == "wheel/odometry":
                x_m, y_m, yaw_rad = se3_to_se2(message.T_odom_body)
                wheels.append(("odometry", message.stamp_ns, float(x_m), float(y_m), float(yaw_rad)))
        found = source.rig()
    finally:
        source.close()
    calibration = found if hasattr(found.camera, "T_body_camera") else found.message(0, str(path))
    if calibration.camera is None or calibration.lidar is None:
        raise UserError(
            f"{path}: the calibration of the camera or of the lidar is missing; add --rig rig.toml"
        )
    if poses is not None:
        trajectory, name = read_tum(poses), str(poses)
    elif stamps:
        order = np.argsort(stamps, kind="stable")
        trajectory = Trajectory(np.array(stamps)[order], np.array(T)[order])
        name = "poses in the recording"
    else:
        trajectory, name = slam_poses(scans, wheels, calibration.lidar.T_body_lidar), "our SLAM"
    images.sort(key=lambda image: image.stamp_ns)
    scans.sort(key=lambda scan: scan.stamp_ns)
    return RecordedDrive(
        Path(path), Pinhole.of(calibration.camera), calibration.camera.T_body_camera,
        calibration.lidar.T_body_lidar, images, scans, trajectory, name,
    )  # fmt: skip


def has_poses(path: Path) -> bool:
    """Return whether a recording has poses: in groundtruth.txt in or beside the bag, or as a pose topic."""
    if any((folder / "groundtruth.txt").is_file() for folder in (Path(path), Path(path).parent)):
        return True
    source = open_source(path, SourceOptions())
    try:
        return any(topic == "external/pose" for _, topic, _ in source.messages())
    finally:
        source.close()


def slam_poses(scans: list[TimedScan], wheels: list[tuple], T_body_lidar: np.ndarray) -> Trajectory:
    """Run the lidar SLAM on scans and odometry; return `T_map_body` at the scans after its last optimisation.

    Args:
        scans: in the order of the recording.
        wheels: ("odometry", stamp_ns, x_m, y_m, yaw_rad), in the order of the recording; may be empty.
        T_body_lidar: float64 [4, 4].

    Raises:
        UserError: there is no usable scan.
    """
    from beamsplat.services.localization.lidar2d.offline_mapping import MeasurementLog, map_measurements

    measured = [
        ("scan", s.stamp_ns, s.ranges_m, s.angle_min_rad, s.angle_increment_rad, s.time_increment_s,
         s.range_min_m, s.range_max_m)
        for s in scans
    ]  # fmt: skip
    merged = sorted([*wheels, *measured], key=lambda measurement: measurement[1])
    with tempfile.TemporaryDirectory() as folder:
        map_measurements(MeasurementLog(T_body_lidar, merged, lambda: None), Path(folder))
        return read_tum(Path(folder) / "trajectory.tum")
