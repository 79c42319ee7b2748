"""A recorded short drive through the textured room: images, scans, wheel odometry, and dense true depth."""

import cv2
import numpy as np
import pytest

from beamsplat.common.geometry.transforms import se2_to_se3, transform_points
from beamsplat.common.messages import CameraModel, Image, LidarModel, Rig, Scan, WheelOdometry
from beamsplat.common.recording import RecordingWriter
from tests.services.fusion.room import CAMERA, LIDAR_Z, T_BODY_CAMERA, cast, render

BEAMS = 360
SECONDS = 6


def pose(stamp_ns):
    s = stamp_ns * 1e-9
    return se2_to_se3(np.array([0.12 * s, 0.3 * np.sin(0.5 * s), 0.25 * np.sin(1.1 * s)]))


def _scan(stamp_ns, rng):
    angle = -np.pi + np.arange(BEAMS) * (2.0 * np.pi / BEAMS)
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(BEAMS)], axis=1)
    T = pose(stamp_ns)
    origin = transform_points(T, np.array([[0.0, 0.0, LIDAR_Z]]))[0]
    r, _ = cast(origin, direction @ T[:3, :3].T)
    return Scan(
        stamp_ns=stamp_ns, angle_min_rad=-np.pi, angle_increment_rad=2.0 * np.pi / BEAMS, time_increment_s=0.0,
        scan_time_s=0.1, range_min_m=0.1, range_max_m=12.0,
        ranges_m=np.where(np.isfinite(r), r + rng.normal(0.0, 0.005, BEAMS), np.inf).astype(np.float32),
    )  # fmt: skip


@pytest.fixture(scope="session")
def drive(tmp_path_factory):
    """Folder with rec/ (30 images, 60 scans, no poses) and depth_gt/ of every sixth image."""
    folder = tmp_path_factory.mktemp("drive")
    (folder / "depth_gt").mkdir()
    rng = np.random.default_rng(5)
    T_body_lidar = np.eye(4)
    T_body_lidar[2, 3] = LIDAR_Z
    camera = CameraModel(
        width_px=CAMERA.width_px, height_px=CAMERA.height_px, fx_px=CAMERA.fx_px, fy_px=CAMERA.fy_px,
        cx_px=CAMERA.cx_px, cy_px=CAMERA.cy_px, T_body_camera=T_BODY_CAMERA,
    )  # fmt: skip
    with RecordingWriter(folder / "rec") as writer:
        rig = Rig(stamp_ns=0, camera=camera, lidar=LidarModel(T_body_lidar=T_body_lidar), source="test")
        writer.write("rig", rig, 1_000_000_000)
        for tick in range(10 * SECONDS):
            stamp = 1_000_000_000 + tick * 100_000_000
            T = pose(stamp)
            wheels = WheelOdometry(
                stamp_ns=stamp, T_odom_body=T, velocity_m_s=np.zeros(3), angular_velocity_rad_s=np.zeros(3)
            )
            writer.write("wheel/odometry", wheels, stamp)
            writer.write("lidar/scan", _scan(stamp, rng), stamp)
            if tick % 2 == 0:
                _write_image(writer, folder, stamp, T, truth=tick % 12 == 0)
    return folder


def _write_image(writer, folder, stamp, T, truth):
    rgb, depth = render(T)
    data = rgb.reshape(-1)
    image = Image(
        stamp_ns=stamp, width_px=rgb.shape[1], height_px=rgb.shape[0], encoding="rgb8", data=data,
        step_bytes=3 * rgb.shape[1],
    )  # fmt: skip
    writer.write("camera/image", image, stamp)
    if truth:
        cv2.imwrite(str(folder / "depth_gt" / f"{stamp}.png"), np.rint(1e3 * depth).astype(np.uint16))
