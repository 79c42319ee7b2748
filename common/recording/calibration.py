"""Finds a robot's calibration in a bag: intrinsics from CameraInfo, mounts from fixed transforms.

What is not there is either a `missing` sentence (the source will not start) or, for what does no harm
or where the user said so, an `assumed` sentence that travels with the calibration.
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
from beamsplat.common.recording.static_frames import StaticFrames, clean

# ROS names for the models we know; anything else is refused by name.
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
    """Calibration as far as it was found. `mounts` are `T_body_sensor` [4, 4] by "camera", "lidar"."""

    camera: dict[str, Any] | None = None  # fields of CameraSection, without the mount
    mounts: dict[str, np.ndarray] = field(default_factory=dict)
    found: list[str] = field(default_factory=list)
    assumed: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    body_frame: str = ""

    def rig(self, source: str) -> RigFile:
        """The rig file with what was found.

        Raises:
            UserError: what was found contradicts itself (K of another image size ...).
        """
        camera = lidar = None
        try:
            if self.camera is not None and "camera" in self.mounts:
                camera = CameraSection(**self.camera, mount=Mount.of(self.mounts["camera"]))
            if "lidar" in self.mounts:
                lidar = LidarSection(mount=Mount.of(self.mounts["lidar"]))
        except ValidationError as error:
            reason = error.errors(include_url=False, include_input=False)[0]["msg"]
            raise UserError(f"{source}: its CameraInfo is not usable: {reason}; give a rig file") from error
        return RigFile(camera=camera, lidar=lidar, assumed=tuple(self.assumed), source=source)


def intrinsics(info: Any, picture_px: tuple[int, int], image_topic: str, where: str) -> dict[str, Any] | None:
    """Fields of CameraSection from a CameraInfo; None if the camera was never calibrated (K all zero).

    `picture_px` is width and height of the pictures themselves. Of a rectified image topic the
    projection matrix P counts and there is no distortion.

    Raises:
        UserError: the sizes differ, or the distortion model is not one we know.
    """
    K, D, P = (np.asarray(_field(info, name), dtype=np.float64).ravel() for name in "kdp")
    if K.size != 9 or K[0] <= 0.0 or K[4] <= 0.0:
        return None
    size = (int(info.width), int(info.height))
    if size != picture_px:
        raise UserError(
            f"{where}: K is for {size[0]}x{size[1]} px but the pictures on {image_topic} are "
            f"{picture_px[0]}x{picture_px[1]} px; give the calibration of this size in a rig file "
            "(`beamsplat rig` writes a first one)"
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
    """ROS 1 writes K, ROS 2 k."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def _distortion(name: str, D: np.ndarray, where: str) -> tuple[str, tuple[float, ...]]:
    model = _MODELS.get(name)
    if model is None:
        known = ", ".join(sorted(set(_MODELS.values())))
        raise UserError(f"{where}: distortion model {name!r} is not known here ({known}); give a rig file")
    if not np.any(D):
        return "none", ()
    size = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4, "none": 0}[model]
    if np.any(D[size:]):
        raise UserError(
            f"{where}: distortion model {name!r} has {len(D)} coefficients where {size} can be used; "
            "give a rig file"
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
    """Fills `mounts` for the sensors in `sensor_frames` ("camera", "lidar" -> frame name)."""
    body = body_frame or frames.body_frame(list(sensor_frames.values()), odometry_child)
    calibration.body_frame = body or ""
    for sensor, frame in sensor_frames.items():
        T = frames.find(body, frame) if body and frame else None
        if T is None:
            _without_mount(calibration, sensor, frame, body, list(sensor_frames), assume)
            continue
        if sensor == "camera":
            T = _optical(calibration, frames, body, frame, T)
        calibration.mounts[sensor] = T
        way = " -> ".join(frames.path(body, frame))
        xyz = ", ".join(f"{value:.3f}" for value in T[:3, 3])
        calibration.found.append(f"{sensor} at ({xyz}) m on the body, from transforms {way}")
    if body and clean(body).split("/")[-1] != "base_footprint" and calibration.mounts:
        calibration.found.append(f"the body is the frame {body!r}")


def _optical(
    calibration: Calibration, frames: StaticFrames, body: str, frame: str, T_body_frame: np.ndarray
) -> np.ndarray:
    """`T_body_camera` of the optical frame, also where the driver stamps pictures with the housing's.

    An optical z axis looks ahead; where the named frame's z axis points up and its x axis lies level,
    the frame is the housing (x forward), unless its name says otherwise.
    """
    z_up = T_body_frame[2, 2] > 0.7
    x_level = abs(T_body_frame[2, 0]) < 0.7
    if "optical" in frame or not (z_up and x_level):
        return T_body_frame
    below = [name for name in sorted(frames.names) if "optical" in name and name.startswith(clean(frame))]
    if len(below) == 1:
        calibration.assumed.append(
            f"pictures stamped {frame!r} are in the optical frame {below[0]!r} below it"
        )
        return frames.find(body, below[0])
    calibration.assumed.append(
        f"frame {frame!r} has its z axis up, so it is the camera's housing: the optical axes were added"
    )
    return T_body_frame @ make_transform(R_body_camera_level, np.zeros(3))


def _without_mount(
    calibration: Calibration, sensor: str, frame: str, body: str | None, sensors: list[str], assume: bool
) -> None:
    joined = (
        f"no fixed transform joins frame {frame!r} to {body!r}" if body else "there are no fixed transforms"
    )
    if sensor == "lidar" and "camera" not in sensors:
        calibration.mounts["lidar"] = np.eye(4)
        calibration.assumed.append(f"the lidar sits at the body's origin, facing forward ({joined})")
    elif assume:
        calibration.mounts[sensor] = ASSUMED_MOUNTS[sensor]
        xyz = ", ".join(f"{value:g}" for value in ASSUMED_MOUNTS[sensor][:3, 3])
        calibration.assumed.append(
            f"the {sensor} sits at ({xyz}) m on the body, level, facing forward ({joined})"
        )
    else:
        calibration.missing.append(f"where the {sensor} sits on the robot is not known ({joined})")


def to_body(fields: dict[str, Any], T_child_body: np.ndarray) -> None:
    """Moves the fields of a wheel odometry of another point of the robot (a base_link above the floor) to
    the body, in place."""
    if np.array_equal(T_child_body, np.eye(4)):
        return
    R_body_child, lever_m = T_child_body[:3, :3].T, T_child_body[:3, 3]
    turning = fields["angular_velocity_rad_s"]
    fields["T_odom_body"] = fields["T_odom_body"] @ T_child_body
    fields["velocity_m_s"] = R_body_child @ (fields["velocity_m_s"] + np.cross(turning, lever_m))
    fields["angular_velocity_rad_s"] = R_body_child @ turning


# Where such sensors often sit on a small robot; a starting point for a tape measure, no more.
ASSUMED_MOUNTS = {
    "camera": camera_mount(0.1, 0.0, 0.3),
    "lidar": make_transform(np.eye(3), np.array([0.0, 0.0, 0.2])),
}
