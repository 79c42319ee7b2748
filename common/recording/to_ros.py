"""Conversion of BeamSplat messages to standard ROS 2 messages, which Foxglove, RViz and `ros2 bag` can use.

A recording contains at most one ROS message with `role = "message"` per BeamSplat message; `RecordingReader`
restores the BeamSplat message from this one. ROS messages with `role = "display"` (transforms, CameraInfo)
are redundant and serve other tools only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from beamsplat.common import messages as m
from beamsplat.common.recording import ros_types as ros

TF = "/tf"
TF_STATIC = "/tf_static"


class RosRecord(NamedTuple):
    """One ROS message, its ROS topic, and its role in a recording."""

    topic: str
    message: Any
    role: str  # "message" or "display"


def records_of(topic: str, message: m.Message) -> list[RosRecord]:
    """Convert a BeamSplat message on `topic` to ROS messages.

    The result is [] if ROS has no such message type (Anchors, Tick, Health).
    """
    convert = _CONVERTERS.get(type(message))
    return convert("/" + topic, message) if convert else []


def _image(topic: str, image: m.Image) -> list[RosRecord]:
    header = ros.header(image.stamp_ns, ros.FRAME_CAMERA)
    if image.encoding in ("jpeg", "png"):
        name = topic + "/compressed"  # naming convention of image_transport
        ros_image = ros.new(
            "sensor_msgs/msg/CompressedImage", header=header, format=image.encoding, data=image.data
        )
    else:
        name = topic
        ros_image = ros.new(
            "sensor_msgs/msg/Image",
            header=header, height=image.height_px, width=image.width_px, encoding=image.encoding,
            is_bigendian=0, step=image.step_bytes % 2**32, data=image.data,
        )  # fmt: skip
    return [RosRecord(name, ros_image, "message")]


def _scan(topic: str, scan: m.Scan) -> list[RosRecord]:
    beams = max(len(scan.ranges_m) - 1, 0)
    laser = ros.new(
        "sensor_msgs/msg/LaserScan",
        header=ros.header(scan.stamp_ns, ros.FRAME_LIDAR),
        angle_min=_float32(scan.angle_min_rad),
        angle_max=_float32(scan.angle_min_rad + beams * scan.angle_increment_rad),
        angle_increment=_float32(scan.angle_increment_rad),
        time_increment=_float32(scan.time_increment_s),
        scan_time=_float32(scan.scan_time_s),
        range_min=_float32(scan.range_min_m),
        range_max=_float32(scan.range_max_m),
        ranges=scan.ranges_m, intensities=scan.intensities,
    )  # fmt: skip
    return [RosRecord(topic, laser, "message")]


def _wheel_odometry(topic: str, odometry: m.WheelOdometry) -> list[RosRecord]:
    twist = ros.new(
        "geometry_msgs/msg/Twist",
        linear=ros.vector(odometry.velocity_m_s), angular=ros.vector(odometry.angular_velocity_rad_s),
    )  # fmt: skip
    message = _nav_odometry(odometry.stamp_ns, odometry.T_odom_body, np.zeros(36), twist)
    return [RosRecord(topic, message, "message")]


def _odometry(topic: str, odometry: m.Odometry) -> list[RosRecord]:
    covariance = np.zeros((6, 6))
    planar = [0, 1, 5]  # x, y, yaw of ROS's (x, y, z, roll, pitch, yaw)
    covariance[np.ix_(planar, planar)] = odometry.covariance
    still = ros.new(
        "geometry_msgs/msg/Twist", linear=ros.vector(np.zeros(3)), angular=ros.vector(np.zeros(3))
    )
    message = _nav_odometry(odometry.stamp_ns, odometry.T_odom_body, covariance.ravel(), still)
    transform = ros.tf(odometry.stamp_ns, ros.FRAME_ODOM, ros.FRAME_BODY, odometry.T_odom_body)
    return [RosRecord(topic, message, "message"), RosRecord(TF, ros.tf_message([transform]), "display")]


def _external_pose(topic: str, pose: m.ExternalPose) -> list[RosRecord]:
    stamped = ros.new(
        "geometry_msgs/msg/PoseStamped",
        header=ros.header(pose.stamp_ns, ros.FRAME_MAP), pose=ros.pose(pose.T_map_body),
    )  # fmt: skip
    return [RosRecord(topic, stamped, "message")]


def _correction(topic: str, correction: m.Correction) -> list[RosRecord]:
    transform = ros.tf(correction.stamp_ns, ros.FRAME_MAP, ros.FRAME_ODOM, correction.T_map_odom)
    return [RosRecord(TF, ros.tf_message([transform]), "message")]


def _grid(topic: str, grid: m.Grid) -> list[RosRecord]:
    rows, columns = grid.occupancy.shape
    origin = np.eye(4)
    origin[:2, 3] = grid.origin_m
    info = ros.new(
        "nav_msgs/msg/MapMetaData",
        map_load_time=ros.time_of(grid.stamp_ns), resolution=_float32(grid.resolution_m),
        width=columns, height=rows, origin=ros.pose(origin),
    )  # fmt: skip
    message = ros.new(
        "nav_msgs/msg/OccupancyGrid",
        header=ros.header(grid.stamp_ns, ros.FRAME_MAP), info=info, data=grid.occupancy.ravel(),
    )  # fmt: skip
    return [RosRecord(topic, message, "message")]


def _rig(topic: str, rig: m.Rig) -> list[RosRecord]:
    records, mounts = [], []
    if rig.camera is not None:
        records.append(RosRecord("/camera/camera_info", camera_info(rig.stamp_ns, rig.camera), "display"))
        mounts.append(ros.tf(rig.stamp_ns, ros.FRAME_BODY, ros.FRAME_CAMERA, rig.camera.T_body_camera))
    if rig.lidar is not None:
        mounts.append(ros.tf(rig.stamp_ns, ros.FRAME_BODY, ros.FRAME_LIDAR, rig.lidar.T_body_lidar))
    if mounts:
        records.append(RosRecord(TF_STATIC, ros.tf_message(mounts), "display"))
    return records


def camera_info(stamp_ns: int, camera: m.CameraModel) -> Any:
    """Return the intrinsics and distortion of a camera as sensor_msgs/CameraInfo."""
    projection = np.hstack([camera.K, np.zeros((3, 1))])
    whole = ros.new(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return ros.new(
        "sensor_msgs/msg/CameraInfo",
        header=ros.header(stamp_ns, ros.FRAME_CAMERA), height=camera.height_px, width=camera.width_px,
        distortion_model="plumb_bob" if camera.distortion_model == "none" else camera.distortion_model,
        d=np.array(camera.distortion, dtype=np.float64), k=camera.K.ravel(), r=np.eye(3).ravel(),
        p=projection.ravel(), binning_x=0, binning_y=0, roi=whole,
    )  # fmt: skip


def _nav_odometry(stamp_ns: int, T_odom_body: np.ndarray, covariance: np.ndarray, twist: Any) -> Any:
    pose = ros.new("geometry_msgs/msg/PoseWithCovariance", pose=ros.pose(T_odom_body), covariance=covariance)
    return ros.new(
        "nav_msgs/msg/Odometry",
        header=ros.header(stamp_ns, ros.FRAME_ODOM), child_frame_id=ros.FRAME_BODY, pose=pose,
        twist=ros.new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )  # fmt: skip


def _float32(value: float) -> float:
    """Clip a value to the range of float32, because serialisation raises on larger values."""
    limit = float(np.finfo(np.float32).max)
    return float(np.clip(value, -limit, limit))


_CONVERTERS: dict[type[m.Message], Callable[[str, Any], list[RosRecord]]] = {
    m.Image: _image,
    m.Scan: _scan,
    m.WheelOdometry: _wheel_odometry,
    m.Odometry: _odometry,
    m.ExternalPose: _external_pose,
    m.Correction: _correction,
    m.Grid: _grid,
    m.Rig: _rig,
}
