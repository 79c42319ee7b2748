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
from beamsplat.common.recording.static_frames import MAX_FRAMES, StaticFrames, normalize_frame

# Distortion model names of ROS -> ours. Other models are rejected.
_MODELS = {
    "": "plumb_bob",
    "plumb_bob": "plumb_bob",
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
    "none": "none",
}


@dataclass
class Calibration:
    """The calibration found in a bag, which may be incomplete."""

    camera: dict[str, Any] | None = None  # fields of CameraSection, without the mount
    mounts: dict[str, np.ndarray] = field(default_factory=dict)  # "camera", "lidar" -> T_body_sensor [4, 4]
    found: list[str] = field(default_factory=list)  # sentences on where values come from
    assumed: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    body_frame: str = ""  # name of the ROS frame used as body

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


def intrinsics(
    info: Any, image_size_px: tuple[int, int], image_topic: str, where: str
) -> dict[str, Any] | None:
    """Return the fields of CameraSection from a CameraInfo; None if the camera is uncalibrated (K is zero).

    For a rectified image topic the intrinsics are taken from the projection matrix P, without distortion.

    Args:
        info: ROS CameraInfo message.
        image_size_px: width and height of the images on the topic.
        image_topic: ROS topic of the images; if it contains "rect", the images are taken as rectified.
        where: name of the CameraInfo's source, for error texts.

    Raises:
        UserError: the CameraInfo has another image size or an unsupported distortion model.
    """
    K, D, P = (np.asarray(_field(info, name), dtype=np.float64).ravel() for name in "kdp")
    if K.size != 9 or K[0] <= 0.0 or K[4] <= 0.0:
        return None
    size = (int(info.width), int(info.height))
    if size != image_size_px:
        raise UserError(
            f"{where}: K is for {size[0]}x{size[1]} px but the images on {image_topic} are "
            f"{image_size_px[0]}x{image_size_px[1]} px; put the calibration for this size in a rig file "
            "(create one with `beamsplat rig`)"
        )
    rectified = "rect" in image_topic and P.size == 12 and P[0] > 0.0
    model, coefficients = ("none", ()) if rectified else _distortion(info.distortion_model, D, where)
    fx, fy, cx, cy = (P[0], P[5], P[2], P[6]) if rectified else (K[0], K[4], K[2], K[5])
    return {
        "width_px": size[0], "height_px": size[1],
        "fx_px": float(fx), "fy_px": float(fy), "cx_px": float(cx), "cy_px": float(cy),
        "distortion_model": model, "distortion": coefficients,
    }  # fmt: skip


def _field(info: Any, name: str) -> Any:
    """Return a field of a CameraInfo; its names are upper case in ROS 1, lower case in ROS 2."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def _distortion(name: str, D: np.ndarray, where: str) -> tuple[str, tuple[float, ...]]:
    model = _MODELS.get(name)
    if model is None:
        known = ", ".join(sorted(set(_MODELS.values())))
        raise UserError(f"{where}: distortion model {name!r} is not supported ({known}); use a rig file")
    if not np.any(D):
        return "none", ()
    size = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4, "none": 0}[model]
    if np.any(D[size:]):
        raise UserError(
            f"{where}: distortion model {name!r} has {len(D)} coefficients, at most {size} are supported; "
            "use a rig file"
        )
    return model, tuple(float(value) for value in np.pad(D[:size], (0, max(0, size - len(D)))))


def find_mounts(
    calibration: Calibration,
    frames: StaticFrames,
    sensor_frames: dict[str, str],
    odometry_child: str,
    body_frame: str,
    assume: bool,
) -> None:
    """Find the mounts of sensors in the static transforms, and add them to `calibration`.

    Args:
        calibration: receives `mounts` (`T_body_sensor`), `body_frame`, and sentences for the user.
        frames: static transforms of the robot.
        sensor_frames: "camera", "lidar" -> name of its ROS frame.
        odometry_child: child frame of the wheel odometry, "" = unknown.
        body_frame: frame to use as body, "" = choose one.
        assume: use `ASSUMED_MOUNTS` where a transform is missing.
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
            if frames.ignored:
                joined += f"; {frames.ignored} transforms to more than {MAX_FRAMES} frames were ignored"
            _handle_missing_mount(calibration, sensor, joined, list(sensor_frames), assume)
            continue
        if sensor == "camera":
            T = _to_optical_frame(calibration, frames, body, frame, T)
        calibration.mounts[sensor] = T
        way = " -> ".join(frames.path(body, frame))
        xyz = ", ".join(f"{value:.3f}" for value in T[:3, 3])
        calibration.found.append(f"{sensor} at ({xyz}) m in the body frame, from transforms {way}")
    if body and normalize_frame(body).split("/")[-1] != "base_footprint" and calibration.mounts:
        calibration.found.append(f"the body is the frame {body!r}")


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
