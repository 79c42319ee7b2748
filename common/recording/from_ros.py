"""Conversion of ROS 1 and ROS 2 messages to the fields of BeamSplat messages.

The fields are not validated yet: `recording.reader` adds the fields that ROS messages do not have, and other
bags contain only the fields of the ROS message.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from beamsplat.common import messages as m
from beamsplat.common.messages.image_header import read_image_header
from beamsplat.common.recording.ros_types import stamp_ns_of, transform_of

# Encodings with several names in ROS: OpenCV's type names and others.
_ENCODINGS = {"8UC3": "bgr8", "8UC1": "mono8", "8UC4": "bgra8", "yuyv": "yuv422_yuy2"}


def fields_of(cls: type[m.Message], ros_message: Any) -> dict[str, Any]:
    """Return the fields of the message class `cls` that a ROS message contains, by name, not validated."""
    return _CONVERTERS[cls](ros_message)


def _image(ros_image: Any) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "stamp_ns": stamp_ns_of(ros_image.header.stamp),
        "data": np.asarray(ros_image.data).view(np.uint8),
    }
    if hasattr(ros_image, "format"):
        head = read_image_header(fields["data"].data)
        if head is not None:
            fields |= head._asdict()
        else:
            fields["encoding"] = ros_image.format
    else:
        fields |= {
            "width_px": ros_image.width,
            "height_px": ros_image.height,
            "encoding": _ENCODINGS.get(ros_image.encoding, ros_image.encoding),
            "step_bytes": ros_image.step,
        }
    return fields


def _scan(laser: Any) -> dict[str, Any]:
    return {
        "stamp_ns": stamp_ns_of(laser.header.stamp),
        "angle_min_rad": float(laser.angle_min),
        "angle_increment_rad": float(laser.angle_increment),
        "time_increment_s": float(laser.time_increment),
        "scan_time_s": float(laser.scan_time),
        "range_min_m": float(laser.range_min),
        "range_max_m": float(laser.range_max),
        "ranges_m": np.asarray(laser.ranges, dtype=np.float32),
        "intensities": np.asarray(laser.intensities, dtype=np.float32),
    }


def _wheel_odometry(odometry: Any) -> dict[str, Any]:
    twist = odometry.twist.twist
    return _odometry_pose(odometry) | {
        "velocity_m_s": _vector(twist.linear),
        "angular_velocity_rad_s": _vector(twist.angular),
    }


def _odometry(odometry: Any) -> dict[str, Any]:
    planar = np.ix_([0, 1, 5], [0, 1, 5])
    covariance = np.asarray(odometry.pose.covariance, dtype=np.float64).reshape(6, 6)[planar]
    return _odometry_pose(odometry) | {"covariance": covariance}


def _odometry_pose(odometry: Any) -> dict[str, Any]:
    pose = odometry.pose.pose
    return {
        "stamp_ns": stamp_ns_of(odometry.header.stamp),
        "T_odom_body": transform_of(pose.position, pose.orientation),
    }


def _external_pose(stamped: Any) -> dict[str, Any]:
    pose = stamped.pose.pose if hasattr(stamped.pose, "pose") else stamped.pose
    T_map_body = transform_of(pose.position, pose.orientation)
    return {"stamp_ns": stamp_ns_of(stamped.header.stamp), "T_map_body": T_map_body}


def _correction(tf_message: Any) -> dict[str, Any]:
    stamped = tf_message.transforms[0]
    T = transform_of(stamped.transform.translation, stamped.transform.rotation)
    return {"stamp_ns": stamp_ns_of(stamped.header.stamp), "T_map_odom": T}


def _grid(grid: Any) -> dict[str, Any]:
    origin = grid.info.origin.position
    return {
        "stamp_ns": stamp_ns_of(grid.header.stamp),
        "resolution_m": float(grid.info.resolution),
        "origin_m": np.array([origin.x, origin.y]),
        "occupancy": np.asarray(grid.data, dtype=np.int8).reshape(grid.info.height, grid.info.width),
    }


def _vector(vector: Any) -> np.ndarray:
    return np.array([vector.x, vector.y, vector.z])


_CONVERTERS = {
    m.Image: _image,
    m.Scan: _scan,
    m.WheelOdometry: _wheel_odometry,
    m.Odometry: _odometry,
    m.ExternalPose: _external_pose,
    m.Correction: _correction,
    m.Grid: _grid,
}
