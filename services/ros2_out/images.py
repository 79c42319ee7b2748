"""Depth maps and rendered images as ROS messages: Image, with the CameraInfo of the same stamp and frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.recording import ros_types as ros

IMAGE, CAMERA_INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"


def depth_image(
    stamp_ns: int,
    frame: str,
    depth_m: np.ndarray,  # float32 [H, W], optical z; NaN = unknown
) -> Any:
    """Return a depth map as sensor_msgs/Image with encoding 32FC1 (REP 118: metres, NaN = unknown)."""
    return _image(stamp_ns, frame, "32FC1", np.ascontiguousarray(depth_m, "<f4"))


def rgb_image(stamp_ns: int, frame: str, rgb: np.ndarray) -> Any:
    """Return an image uint8 [H, W, 3] as sensor_msgs/Image with encoding rgb8."""
    return _image(stamp_ns, frame, "rgb8", np.ascontiguousarray(rgb))


def camera_info(stamp_ns: int, frame: str, camera: Pinhole) -> Any:
    """Return the CameraInfo of an undistorted image of `camera`.

    ROS, too, puts pixel centres at integers.

    Raises:
        ValueError: the camera has a lens distortion.
    """
    if camera.is_distorted:
        raise ValueError(f"the image is undistorted, its camera is not: {camera}")
    whole = ros.new(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return ros.new(
        CAMERA_INFO,
        header=ros.header(stamp_ns, frame), height=camera.height_px, width=camera.width_px,
        distortion_model="plumb_bob", d=np.zeros(5), k=camera.K.ravel(), r=np.eye(3).ravel(),
        p=np.hstack([camera.K, np.zeros((3, 1))]).ravel(), binning_x=0, binning_y=0, roi=whole,
    )  # fmt: skip


def info_topic(image_topic: str) -> str:
    """Return the topic of an image's CameraInfo: `camera_info` beside it, where ROS nodes expect it."""
    return image_topic.strip("/").rpartition("/")[0] + "/camera_info" if image_topic else ""


def _image(stamp_ns: int, frame: str, encoding: str, pixels: np.ndarray) -> Any:
    rows = pixels.view(np.uint8).reshape(pixels.shape[0], -1)
    return ros.new(
        IMAGE,
        header=ros.header(stamp_ns, frame), height=pixels.shape[0], width=pixels.shape[1], encoding=encoding,
        is_bigendian=0, step=rows.shape[1], data=rows.reshape(-1),
    )  # fmt: skip
