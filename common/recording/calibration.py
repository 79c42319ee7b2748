"""Extraction of a robot's calibration from a bag: intrinsics from CameraInfo, mounts from static transforms.

A missing value adds a sentence to `missing`, and the source does not start; if a default value is acceptable,
or the user allows assumptions, it adds a sentence to `assumed`, which is part of the calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import ValidationError

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.frames import R_body_camera_level, camera_mount
from beamsplat.common.geometry.rig import CameraSection, LidarSection, Mount, RigFile
from beamsplat.common.geometry.transforms import make_transform
from beamsplat.common.recording.camera_info import CameraInfoIntrinsics
from beamsplat.common.recording.static_frames import MAX_FRAMES, StaticFrames, normalize_frame

MAX_TILT_DEG = 10.0  # of the lidar's plane; ranges then differ by 1.5 % from those of a level lidar
_LIMIT_M = 20.0  # of a position on the robot
_LEVEL_DEG = 2.0  # below it, a tilt is not mentioned


@dataclass
class Calibration:
    """The calibration found in a bag, which may be incomplete."""

    camera: dict[str, Any] | None = None  # fields of CameraSection, without the mount
    mounts: dict[str, np.ndarray] = field(default_factory=dict)  # "camera", "lidar" -> T_body_sensor [4, 4]
    found: list[str] = field(default_factory=list)  # sentences on where values come from
    assumed: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)  # sentences on values that contradict each other
    body_frame: str = ""  # name of the ROS frame used as body

    def add_intrinsics(self, read: CameraInfoIntrinsics | None, topic: str) -> None:
        """Add the intrinsics read from a CameraInfo topic; None: all its messages have a K of zeros."""
        if read is None:
            self.missing.append(f"K on {topic} is all zero: this camera was never calibrated")
            return
        K = self.camera = read.fields
        self.found.append(
            f"K from {topic}: fx {K['fx_px']:.1f}, fy {K['fy_px']:.1f}, cx {K['cx_px']:.1f}, "
            f"cy {K['cy_px']:.1f} px for {K['width_px']}x{K['height_px']}, "
            f"distortion {K['distortion_model']}"
        )
        self.found += [f"{topic}: {note}" for note in read.notes]
        self.doubts += [f"{topic}: {doubt}" for doubt in read.doubts]

    def rig(self, source: str) -> RigFile:
        """Return a rig file with the sensors whose calibration was found; `source` names the bag.

        Raises:
            UserError: the values are inconsistent, for example K of another image size.
        """
        camera = lidar = None
        try:
            if self.camera is not None and "camera" in self.mounts:
                camera = CameraSection(**self.camera, mount=Mount.of(self.mounts["camera"]))
            if "lidar" in self.mounts:
                lidar = LidarSection(mount=Mount.of(self.mounts["lidar"]))
        except ValidationError as error:
            reason = error.errors(include_url=False, include_input=False)[0]["msg"]
            raise UserError(f"{source}: its CameraInfo is invalid: {reason}; use a rig file") from error
        return RigFile(camera=camera, lidar=lidar, assumed=tuple(self.assumed), source=source)


def find_mounts(
    calibration: Calibration,
    frames: StaticFrames,
    sensor_frames: dict[str, str],
    odometry_child: str,
    body_frame: str,
    assume: bool,
    beside: str = "",
) -> None:
    """Find the mounts of sensors in the static transforms, and add them to `calibration`.

    Args:
        calibration: receives `mounts` (`T_body_sensor`), `body_frame`, and sentences for the user.
        frames: static transforms of the robot.
        sensor_frames: "camera", "lidar" -> name of its ROS frame.
        odometry_child: child frame of the wheel odometry, "" = unknown.
        body_frame: frame to use as body, "" = choose one.
        assume: use `ASSUMED_MOUNTS` where a transform is missing.
        beside: why transforms that exist do not belong to the sensors, "" = they do.
    """
    body = body_frame or frames.body_frame(list(sensor_frames.values()), odometry_child)
    calibration.body_frame = body or ""
    for sensor, frame in sensor_frames.items():
        T = frames.find(body, frame) if body and frame else None
        if T is None or body is None:
            joined = (
                f"no static transform connects frame {frame!r} to {body!r}"
                if body
                else "there are no static transforms"
            )
            if beside:
                calibration.missing.append(f"the position of the {sensor} on the robot is unknown: {beside}")
                continue
            moving = frames.moving_between(body, frame) if body else []
            if moving:
                pairs = ", ".join(f"{parent} -> {child}" for parent, child in moving)
                calibration.missing.append(
                    f"the {sensor} is on a moving mount: the transform {pairs} changes during the "
                    "drive; hold it "
                    "still, or record without this sensor"
                )
                continue
            if frames.ignored:
                joined += f"; {frames.ignored} transforms to more than {MAX_FRAMES} frames were ignored"
            _handle_missing_mount(calibration, sensor, joined, list(sensor_frames), assume)
            continue
        if float(np.abs(T[:3, 3]).max()) > _LIMIT_M:
            xyz = ", ".join(f"{value:g}" for value in T[:3, 3])
            calibration.missing.append(
                f"the transforms put the {sensor} at ({xyz}) m in the body frame, which is no place on "
                "a robot; "
                "they may be in millimetres"
            )
            continue
        if sensor == "camera":
            T = _to_optical_frame(calibration, frames, body, frame, T)
        calibration.mounts[sensor] = T
        calibration.doubts += frames.changes_between(body, frame)
        way = " -> ".join(frames.path(body, frame))
        xyz = ", ".join(f"{value:.3f}" for value in T[:3, 3])
        calibration.found.append(f"{sensor} at ({xyz}) m in the body frame, from transforms {way}")
    if body and normalize_frame(body).split("/")[-1] != "base_footprint" and calibration.mounts:
        calibration.found.append(f"the body is the frame {body!r}")


def check_lidar_plane(T_body_lidar: np.ndarray, where: str) -> str:
    """Return a sentence if the lidar's plane is slightly tilted, else "".

    `where`: file or topic and frame that the mount comes from, for texts.

    Raises:
        UserError: the plane is tilted by more than 10 degrees: the scans are not level.
    """
    tilt_deg = float(np.degrees(np.arccos(np.clip(abs(T_body_lidar[2, 2]), 0.0, 1.0))))
    if tilt_deg > MAX_TILT_DEG:
        raise UserError(
            f"{where}: the plane of the lidar is tilted by {tilt_deg:.0f} degrees from the floor; a map "
            "needs a level "
            "lidar: publish the scans in a frame whose z axis points up (not in an optical frame; for "
            "depthimage_to_laserscan set output_frame), correct the transform, or give the mount in a "
            "rig file"
        )
    if tilt_deg > _LEVEL_DEG:
        return (
            f"{where}: the plane of the lidar is tilted by {tilt_deg:.1f} degrees, ranges are taken as level"
        )
    return ""


def _to_optical_frame(
    calibration: Calibration, frames: StaticFrames, body: str, frame: str, T_body_frame: np.ndarray
) -> np.ndarray:
    """Return `T_body_camera` of the optical frame, also if the driver stamps images with the housing's frame.

    The z axis of an optical frame points forward. If the z axis of `frame` points up and its x axis is level,
    `frame` is taken as the housing (x forward), unless its name contains "optical".
    """
    z_up = T_body_frame[2, 2] > 0.7
    x_level = abs(T_body_frame[2, 0]) < 0.7
    if "optical" in frame or not (z_up and x_level):
        return T_body_frame
    below = [
        name for name in sorted(frames.names) if "optical" in name and name.startswith(normalize_frame(frame))
    ]
    if len(below) == 1 and (T_body_camera := frames.find(body, below[0])) is not None:
        calibration.assumed.append(
            f"images stamped {frame!r} are in its child, the optical frame {below[0]!r}"
        )
        return T_body_camera
    calibration.assumed.append(
        f"frame {frame!r} has its z axis up, so it is the camera's housing: the optical rotation was added"
    )
    return T_body_frame @ make_transform(R_body_camera_level, np.zeros(3))


def _handle_missing_mount(
    calibration: Calibration, sensor: str, joined: str, sensors: list[str], assume: bool
) -> None:
    """Use a default mount, or state that the mount is missing; `joined`: why no transform was found."""
    if sensor == "lidar" and "camera" not in sensors:
        calibration.mounts["lidar"] = np.eye(4)
        calibration.assumed.append(f"the lidar is at the body's origin, facing forward ({joined})")
    elif assume:
        calibration.mounts[sensor] = ASSUMED_MOUNTS[sensor]
        xyz = ", ".join(f"{value:g}" for value in ASSUMED_MOUNTS[sensor][:3, 3])
        calibration.assumed.append(
            f"the {sensor} is at ({xyz}) m in the body frame, level, facing forward ({joined})"
        )
    else:
        calibration.missing.append(f"the position of the {sensor} on the robot is unknown ({joined})")


def move_odometry_to_body(fields: dict[str, Any], T_child_body: np.ndarray) -> None:
    """Transform the fields of a wheel odometry message from its child frame to the body frame, in place.

    Args:
        fields: of a WheelOdometry message: the pose `T_odom_body` [4, 4] and the velocities [3].
        T_child_body: [4, 4]. The child frame can differ from the body, for example a base_link above the
            floor.
    """
    if np.array_equal(T_child_body, np.eye(4)):
        return
    R_body_child, lever_m = T_child_body[:3, :3].T, T_child_body[:3, 3]
    turning = fields["angular_velocity_rad_s"]
    fields["T_odom_body"] = fields["T_odom_body"] @ T_child_body
    fields["velocity_m_s"] = R_body_child @ (fields["velocity_m_s"] + np.cross(turning, lever_m))
    fields["angular_velocity_rad_s"] = R_body_child @ turning


# Typical mounts on a small robot; a rough start value only, to be replaced by measured values.
ASSUMED_MOUNTS = {
    "camera": camera_mount(0.1, 0.0, 0.3),
    "lidar": make_transform(np.eye(3), np.array([0.0, 0.0, 0.2])),
}
