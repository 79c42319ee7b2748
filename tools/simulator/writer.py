"""Writes the recording as a ROS 2 bag (MCAP), and the ground-truth files beside it."""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from beamsplat.common.geometry.transforms import quat_xyzw_from_matrix
from beamsplat.common.scans.laser import LaserMessage
from beamsplat.tools.simulator.bag_layout import BagLayout
from beamsplat.tools.simulator.settings import CameraSettings, SimulationSettings

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types


@dataclass(frozen=True)
class BagRecord:
    """One message of the bag: time of receipt, topic, and the message serialised as CDR bytes."""

    received_ns: int
    topic: str
    data: bytes


def write_bag(path: Path, streams: Iterable[Iterator[BagRecord]], layout: BagLayout, *, camera: bool) -> int:
    """Write a new bag folder with the messages of all streams, merged by time of receipt.

    Each stream must be in order of receipt; its topics are those of `layout`.

    Returns:
        The number of written messages.
    """
    count = 0
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        unreliable = set() if layout.reliable else layout.sensor_topics()
        connections = {
            name: bag.add_connection(
                name, kind, typestore=STORE,
                offered_qos_profiles=[_qos(name, reliable=name not in unreliable)],
            )
            for name, kind in layout.topics(camera=camera).items()
        }  # fmt: skip
        for record in heapq.merge(*streams, key=lambda r: r.received_ns):
            bag.write(connections[record.topic], record.received_ns, record.data)
            count += 1
    return count


def _qos(topic: str, *, reliable: bool) -> Qos:
    latched = topic == "/tf_static"
    zero = QosTime(0, 0)
    return Qos(
        QosHistory.KEEP_LAST,
        1 if latched else 10,
        QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        zero,
        zero,
        QosLiveliness.AUTOMATIC,
        zero,
        False,
    )


def _cdr(message: Any) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def _make(kind: str, *values: Any) -> Any:
    return TYPES[kind](*values)


def _header(stamp_ns: int, frame: str) -> Any:
    time = _make("builtin_interfaces/msg/Time", int(stamp_ns // 10**9), int(stamp_ns % 10**9))
    return _make("std_msgs/msg/Header", time, frame)


def _vector(xyz: np.ndarray) -> Any:
    return _make("geometry_msgs/msg/Vector3", *(float(v) for v in xyz))


def _quaternion(R: np.ndarray) -> Any:
    return _make("geometry_msgs/msg/Quaternion", *(float(v) for v in quat_xyzw_from_matrix(R)))


def _stamped(stamp_ns: int, parent: str, child: str, T: np.ndarray) -> Any:
    transform = _make("geometry_msgs/msg/Transform", _vector(T[:3, 3]), _quaternion(T[:3, :3]))
    return _make("geometry_msgs/msg/TransformStamped", _header(stamp_ns, parent), child, transform)


def tf_bytes(stamp_ns: int, links: list[tuple[str, str, np.ndarray]]) -> bytes:
    """Return the CDR bytes of a tf2_msgs/TFMessage; links are (parent frame, child frame, T_parent_child)."""
    return _cdr(_make("tf2_msgs/msg/TFMessage", [_stamped(stamp_ns, *link) for link in links]))


def odometry_bytes(
    stamp_ns: int, T_odom_body: np.ndarray, speed_m_s: float, turn_rad_s: float, layout: BagLayout
) -> bytes:
    """Return the CDR bytes of a nav_msgs/Odometry with the pose `T_odom_body` [4, 4], speed and yaw rate.

    The covariances are constant, with values that are typical of drivers of planar robots.
    """
    point = _make("geometry_msgs/msg/Point", *(float(v) for v in T_odom_body[:3, 3]))
    pose = _make("geometry_msgs/msg/Pose", point, _quaternion(T_odom_body[:3, :3]))
    covariances = [np.diag([v, v, 1e6, 1e6, 1e6, w]).ravel() for v, w in ((1e-2, 2e-2), (1e-3, 2e-3))]
    twist = _make(
        "geometry_msgs/msg/Twist", _vector(np.array([speed_m_s, 0, 0])), _vector(np.array([0, 0, turn_rad_s]))
    )
    return _cdr(
        _make(
            "nav_msgs/msg/Odometry",
            _header(stamp_ns, layout.odometry_frame),
            layout.base_frame,
            _make("geometry_msgs/msg/PoseWithCovariance", pose, covariances[0]),
            _make("geometry_msgs/msg/TwistWithCovariance", twist, covariances[1]),
        )
    )


def scan_bytes(m: LaserMessage) -> bytes:
    """Return the CDR bytes of a sensor_msgs/LaserScan."""
    return _cdr(
        _make(
            "sensor_msgs/msg/LaserScan",
            _header(m.stamp_ns, m.frame_id),
            m.angle_min_rad,
            m.angle_max_rad,
            m.angle_increment_rad,
            m.time_increment_s,
            m.scan_time_s,
            m.range_min_m,
            m.range_max_m,
            m.ranges_m,
            m.intensities,
        )
    )


def image_bytes(stamp_ns: int, jpeg: np.ndarray, layout: BagLayout) -> bytes:
    """Return the CDR bytes of a sensor_msgs/CompressedImage or Image of JPEG bytes uint8 [B]."""
    header = _header(stamp_ns, layout.camera_frame)
    if layout.image_encoding == "jpeg":
        return _cdr(_make("sensor_msgs/msg/CompressedImage", header, layout.jpeg_format, jpeg))
    bgr = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    assert bgr is not None  # the simulator's own bytes
    rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    height, width = rgb.shape[:2]
    image = (header, height, width, "rgb8", 0, 3 * width, rgb.ravel())
    return _cdr(_make("sensor_msgs/msg/Image", *image))


def camera_info_bytes(stamp_ns: int, camera: CameraSettings, layout: BagLayout) -> bytes:
    """Return the CDR bytes of a sensor_msgs/CameraInfo with the camera's intrinsics and distortion."""
    K = camera.K
    P = np.hstack([K, np.zeros((3, 1))])
    region = _make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    distortion = np.zeros(8 if layout.distortion_model == "rational_polynomial" else 5)
    distortion[:5] = camera.distortion
    return _cdr(
        _make(
            "sensor_msgs/msg/CameraInfo",
            _header(stamp_ns, layout.camera_frame),
            camera.height_px,
            camera.width_px,
            layout.distortion_model,
            distortion,
            K.ravel(),
            np.eye(3).ravel(),
            P.ravel(),
            0,
            0,
            region,
        )
    )


def write_tum(path: Path, stamps_ns: np.ndarray, T_world_body: np.ndarray) -> None:
    """Write poses [N, 4, 4] as a TUM trajectory, with stamps in seconds that have nine decimals."""
    lines = ["# timestamp_s tx ty tz qx qy qz qw  (T_world_base)"]
    for stamp, T in zip(stamps_ns.tolist(), T_world_body):
        numbers = " ".join(f"{v:.9f}" for v in (*T[:3, 3], *quat_xyzw_from_matrix(T[:3, :3])))
        lines.append(f"{stamp // 10**9}.{stamp % 10**9:09d} {numbers}")
    path.write_text("\n".join(lines) + "\n")


def transform_json(T: np.ndarray) -> dict[str, Any]:
    """Return a transform [4, 4] for a JSON file, as a matrix and also as a translation and a quaternion."""
    return {
        "matrix": T.tolist(),
        "translation_xyz": T[:3, 3].tolist(),
        "quaternion_xyzw": quat_xyzw_from_matrix(T[:3, :3]).tolist(),
    }


def write_camera_json(path: Path, settings: SimulationSettings) -> None:
    """Write the true calibration of camera and lidar, and the faults, as a JSON file.

    Its key `published_T_base_camera` is the pose of the camera in the bag's tf; with an extrinsic fault, this
    pose differs from the true `T_base_camera`.
    """
    camera, lidar, faults, layout = settings.camera, settings.lidar, settings.faults, settings.layout
    K = camera.K
    text: dict[str, Any] = {
        "width": camera.width_px,
        "height": camera.height_px,
        "model": "pinhole",
        "fx": K[0, 0],
        "fy": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "distortion_model": "plumb_bob",
        "distortion": list(camera.distortion),
        "rate_hz": camera.rate_hz,
        "pixel_convention": "pixel centres at integer coordinates: u = fx*X/Z+cx",
        "depth_unit": "uint16 millimetres along optical z, 0 = no surface",
        "depth_grid": "depth_gt and moving_masks have the images' distorted pixels; extra_views are pinhole",
        "frames": {
            "base": f"{layout.base_frame} (on the floor between the wheels, x forward, z up)",
            "camera": f"{layout.camera_frame} (x right, y down, z forward)",
            "lidar": layout.lidar_frame,
        },
        "T_base_camera": transform_json(camera.T_body_camera),
        "T_base_lidar": transform_json(lidar.T_body_lidar),
        "published_T_base_camera": transform_json(faults.published_mount(camera.T_body_camera)),
        "camera_clock_offset_ms": faults.clock_offset_ms,
        "exposure_changes": faults.exposure_changes,
        "lidar": {
            "beams": lidar.beams,
            "angle_min": lidar.angle_min_rad,
            "angle_increment": lidar.angle_increment_rad,
            "rate_hz": lidar.rate_hz,
            "scan_time": lidar.scan_time_s,
            "time_increment": lidar.time_increment_s,
            "range_min": lidar.range_min_m,
            "range_max": lidar.range_max_m,
            "noise_sigma_m": lidar.noise_m,
            "dropout": lidar.dropout,
            "glass": lidar.glass,
            "stamp": "time of the first beam",
            "order": "that of measurement, as in beams.npz; the driver may publish another one",
        },
    }
    path.write_text(json.dumps(text, indent=1) + "\n")


def write_ply(path: Path, points_m: np.ndarray, colours: np.ndarray) -> None:
    """Write a binary PLY file of points [N, 3] in metres with RGB colours uint8 [N, 3]."""
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points_m)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    )
    rows = np.zeros(len(points_m), dtype=[("p", "<f4", 3), ("c", "u1", 3)])
    rows["p"], rows["c"] = points_m, colours
    path.write_bytes(head.encode() + rows.tobytes())


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an image [H, W] or BGR [H, W, 3], uint8 or uint16, as a PNG file."""
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
