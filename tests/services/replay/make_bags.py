"""Small real bags of every kind, written with rosbags: the same drive each time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import make_transform, quat_xyzw_from_matrix

KINDS = ("ros1", "sqlite", "mcap")
START_NS = 1_700_000_000 * 10**9
T_BASE_CAMERA = camera_mount(0.1, 0.02, 0.45, pitch_down_rad=np.radians(3.0))
T_BASE_LIDAR = make_transform(np.eye(3), np.array([0.05, 0.0, 0.18]))
LAG_NS = 30_000_000


@dataclass
class Drive:
    """What the bag shall hold. Lag: scans arrive 30 ms after their stamp, the rest at once."""

    seconds: float = 2.0
    scan: bool = True
    images: str = "jpeg"  # "", "jpeg", "rgb8"
    info_px: tuple[int, int] | None = (64, 48)
    fx_px: float = 50.0
    distortion: tuple[str, list[float]] = ("plumb_bob", [0.1, 0.0, 0.0, 0.0, 0.0])
    odometry: bool = True
    odometry_child: str = "base_link"
    pose: bool = False
    tf: str = "static"  # "", "static", "repeated"
    chain: bool = False  # camera bolted to a mast, the mast to the base
    camera_frame: str = "camera_optical_frame"
    T_base_camera: np.ndarray = field(default_factory=lambda: T_BASE_CAMERA)
    footprint: bool = False  # base_link 0.1 m above base_footprint
    extra_scan: str = ""  # a second lidar's topic
    stamped: bool = True
    corrupt_scans: int = 0
    compression: CompressionMode | None = None  # ROS 2 only


class RobotBag:
    """rosbags' two writers behind one face."""

    def __init__(self, path: Path, kind: str) -> None:
        self.ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            name = "tf2_msgs/msg/TFMessage"
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
            self.writer = Writer1(path)
        else:
            plugin = StoragePlugin.SQLITE3 if kind == "sqlite" else StoragePlugin.MCAP
            self.writer = Writer2(path, version=8, storage_plugin=plugin)
        self.connections = {}

    def new(self, name, **fields):
        return self.store.types[name](**fields)

    def header(self, stamp_ns, frame):
        stamp = self.new("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        seq = {"seq": 0} if self.ros1 else {}
        return self.new("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **seq)

    def vector(self, values, kind="Vector3"):
        return self.new(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", map(float, values))))

    def quaternion(self, R):
        return self.new(
            "geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, quat_xyzw_from_matrix(R))))
        )

    def pose(self, T):
        return self.new(
            "geometry_msgs/msg/Pose",
            position=self.vector(T[:3, 3], "Point"),
            orientation=self.quaternion(T[:3, :3]),
        )

    def tf(self, stamp_ns, edges):
        made = [
            self.new(
                "geometry_msgs/msg/TransformStamped", header=self.header(stamp_ns, parent), child_frame_id=child,
                transform=self.new(
                    "geometry_msgs/msg/Transform", translation=self.vector(T[:3, 3]),
                    rotation=self.quaternion(T[:3, :3]),
                ),
            )
            for parent, child, T in edges
        ]  # fmt: skip
        return self.new("tf2_msgs/msg/TFMessage", transforms=made)

    def write(self, topic, message, at_ns, corrupt=False):
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        data = bytes(serialize(message, name))
        self.writer.write(self.connections[topic], at_ns, data[:30] if corrupt else data)


def picture(number: int) -> np.ndarray:
    """uint8 [48, 64, 3], another one for each number."""
    return np.random.default_rng(number).integers(0, 255, (48, 64, 3), dtype=np.uint8)


def edges_of(drive: Drive) -> list[tuple[str, str, np.ndarray]]:
    """Fixed transforms (parent, child, T_parent_child)."""
    edges = [("base_link", "laser", T_BASE_LIDAR)]
    if drive.chain:
        mast = make_transform(np.eye(3), np.array([0.0, 0.0, 0.3]))
        edges += [
            ("base_link", "mast", mast),
            ("mast", drive.camera_frame, np.linalg.inv(mast) @ drive.T_base_camera),
        ]
    else:
        edges.append(("base_link", drive.camera_frame, drive.T_base_camera))
    if drive.footprint:
        edges.append(("base_footprint", "base_link", make_transform(np.eye(3), np.array([0.0, 0.0, 0.1]))))
    return edges


def write_bag(folder: Path, kind: str, drive: Drive) -> Path:
    """Writes one bag; its path (a file for ROS 1, a folder for ROS 2)."""
    path = folder / ("drive.bag" if kind == "ros1" else "drive")
    bag = RobotBag(path, kind)
    if drive.compression is not None:
        bag.writer.set_compression(drive.compression, CompressionFormat.ZSTD)
    with bag.writer:
        if drive.tf == "static":
            bag.write("/tf_static", bag.tf(START_NS, edges_of(drive)), START_NS)
        for i in range(round(drive.seconds * 10)):
            _moment(bag, drive, i, START_NS + i * 10**8)
    return path


def _moment(bag: RobotBag, drive: Drive, i: int, now_ns: int) -> None:
    stamp_ns = now_ns if drive.stamped else 0
    if drive.odometry:
        bag.write("/odom", _odometry(bag, drive, i, stamp_ns), now_ns)
    if drive.tf == "repeated":
        moving = ("odom", "base_link", make_transform(np.eye(3), np.array([0.1 * i, 0.0, 0.0])))
        bag.write("/tf", bag.tf(now_ns, [moving, *edges_of(drive)]), now_ns)
    if drive.images:
        name = "/camera/image_raw" + ("/compressed" if drive.images == "jpeg" else "")
        bag.write(name, _image(bag, drive, i, stamp_ns), now_ns)
        if drive.info_px:
            bag.write("/camera/camera_info", _info(bag, drive, stamp_ns), now_ns)
    if drive.pose:
        T = make_transform(np.eye(3), np.array([0.1 * i, 1.0, 0.0]))
        stamped = bag.new(
            "geometry_msgs/msg/PoseStamped", header=bag.header(stamp_ns, "map"), pose=bag.pose(T)
        )
        bag.write("/pose", stamped, now_ns)
    for topic in ["/scan"] * drive.scan + [drive.extra_scan] * bool(drive.extra_scan):
        bag.write(topic, laser_scan(bag, i, stamp_ns), now_ns + LAG_NS, corrupt=0 < i <= drive.corrupt_scans)


def _odometry(bag, drive, i, stamp_ns):
    pose = make_transform(np.eye(3), np.array([0.1 * i, 0.0, 0.0]))
    twist = bag.new(
        "geometry_msgs/msg/Twist", linear=bag.vector([1.0, 0, 0]), angular=bag.vector([0, 0, 0.5])
    )
    return bag.new(
        "nav_msgs/msg/Odometry", header=bag.header(stamp_ns, "odom"), child_frame_id=drive.odometry_child,
        pose=bag.new("geometry_msgs/msg/PoseWithCovariance", pose=bag.pose(pose), covariance=np.zeros(36)),
        twist=bag.new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )  # fmt: skip


def laser_scan(bag, i, stamp_ns):
    ranges = np.full(36, 2.0 + 0.01 * i, np.float32)
    ranges[:2] = np.inf, np.nan
    return bag.new(
        "sensor_msgs/msg/LaserScan", header=bag.header(stamp_ns, "laser"), angle_min=-3.0, angle_max=3.0,
        angle_increment=0.17, time_increment=1e-3, scan_time=0.1, range_min=0.1, range_max=12.0,
        ranges=ranges, intensities=np.arange(36, dtype=np.float32),
    )  # fmt: skip


def _image(bag, drive, i, stamp_ns):
    header = bag.header(stamp_ns, drive.camera_frame)
    if drive.images == "jpeg":
        data = cv2.imencode(".jpg", picture(i))[1].ravel()
        return bag.new(
            "sensor_msgs/msg/CompressedImage", header=header, format="bgr8; jpeg compressed bgr8", data=data
        )
    return bag.new(
        "sensor_msgs/msg/Image", header=header, height=48, width=64, encoding=drive.images, is_bigendian=0,
        step=192, data=picture(i).ravel(),
    )  # fmt: skip


def _info(bag, drive, stamp_ns):
    return camera_info(bag, stamp_ns, drive.fx_px, drive.info_px, drive.distortion, frame=drive.camera_frame)


def camera_info(
    bag, stamp_ns, fx, size, distortion=("plumb_bob", []), roi=(0, 0, 0, 0), binning=(0, 0), centre=None,
    p_fx=None, frame="camera_optical_frame",
):  # fmt: skip
    """A CameraInfo; `centre`: principal point, by default the middle; `p_fx`: focal length in P."""
    width, height = size
    cx, cy = centre or ((width - 1) / 2, (height - 1) / 2)
    K = np.array([fx, 0, cx, 0, fx, cy, 0, 0, 1.0])
    P = np.array([p_fx or fx, 0, cx, 0, 0, p_fx or fx, cy, 0, 0, 0, 1.0, 0])
    matrices = dict(
        zip("DKRP" if bag.ros1 else "dkrp", (np.array(distortion[1], np.float64), K, np.eye(3).ravel(), P))
    )
    x, y, w, h = roi
    region = bag.new(
        "sensor_msgs/msg/RegionOfInterest", x_offset=x, y_offset=y, height=h, width=w, do_rectify=False
    )
    return bag.new(
        "sensor_msgs/msg/CameraInfo", header=bag.header(stamp_ns, frame), height=height, width=width,
        distortion_model=distortion[0], binning_x=binning[0], binning_y=binning[1], roi=region, **matrices,
    )  # fmt: skip
