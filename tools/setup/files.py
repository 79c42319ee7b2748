"""Create the two files of `beamsplat setup`: robot.toml (deployment) and rig.toml (calibration)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from beamsplat.common.geometry.frames import camera_mount, lidar_mount
from beamsplat.common.geometry.rig import CameraSection, LidarSection, Mount, RigFile, format_rig
from beamsplat.tools.setup.intrinsics import CameraIntrinsics

_HEADER = """Calibration of one robot, by `beamsplat setup`: mounts of the sensors, camera intrinsics.
The body frame is on the floor between the wheels: x forward, y left, z up. Metres and degrees.
rpy_deg = [roll, pitch, yaw]: zero is level and straight ahead; positive pitch looks down,
positive yaw turns to the left."""


@dataclass(frozen=True)
class MeasuredMount:
    """Position and one angle of a sensor in the body frame, measured by hand with a tape."""

    forward_m: float
    left_m: float
    up_m: float
    down_deg: float = 0.0  # pitch, positive down
    left_deg: float = 0.0  # yaw, positive left

    def T_body_camera(self) -> np.ndarray:
        """Return the pose of a camera with this mount (optical frame) in the body frame, float64 [4, 4]."""
        return camera_mount(self.forward_m, self.left_m, self.up_m, pitch_down_rad=np.radians(self.down_deg))

    def T_body_lidar(self) -> np.ndarray:
        """Return the pose of a lidar with this mount in the body frame, float64 [4, 4]."""
        return lidar_mount(self.forward_m, self.left_m, self.up_m, yaw_left_rad=np.radians(self.left_deg))


def camera_section(lens: CameraIntrinsics, T_body_camera: np.ndarray) -> CameraSection:
    """Return the section [camera] of rig.toml with these intrinsics and the mount `T_body_camera` [4, 4]."""
    K = np.round(lens.K, 4)
    return CameraSection(
        width_px=lens.size_px[0], height_px=lens.size_px[1], fx_px=float(K[0, 0]), fy_px=float(K[1, 1]),
        cx_px=float(K[0, 2]), cy_px=float(K[1, 2]), distortion_model="plumb_bob",
        distortion=tuple(round(float(v), 6) for v in lens.distortion), mount=Mount.of(T_body_camera),
    )  # fmt: skip


def rig_text(
    camera: CameraSection | None, T_body_lidar: np.ndarray, assumed: tuple[str, ...], note: str
) -> str:
    """Return the text of rig.toml.

    Args:
        camera: section [camera]; None without a camera.
        T_body_lidar: mount of the lidar, float64 [4, 4].
        assumed: descriptions of values that were not measured.
        note: comment in the file: how the camera was calibrated.
    """
    rig = RigFile(
        camera=camera,
        lidar=LidarSection(mount=Mount.of(T_body_lidar)),
        assumed=assumed,
        source="beamsplat setup",
    )
    return format_rig(rig, _HEADER, {"camera": note})


def robot_text(robot: str, rig: str, camera: dict[str, Any] | None, lidar: dict[str, Any]) -> str:
    """Return the text of robot.toml: a deployment with the sensors, localization, depth, fusion and page.

    Args:
        robot: name of the robot.
        rig: path of rig.toml.
        camera: options of the camera node; None: a deployment without camera, depth and fusion.
        lidar: options of the lidar node.
    """
    sections: list[tuple[str, dict[str, Any]]] = [
        ("camera", {"kind": "none", "rig": rig} if camera is None else {**camera, "rig": rig}),
        ("lidar", lidar),
        ("localization", {"kind": "lidar"}),
    ]
    if camera is not None:
        sections += [("depth", {"source": "stixel"}), ("fusion", {})]
    sections.append(("page", {}))
    lines = [
        "# Written by `beamsplat setup`. docs/sensors.md and docs/page.md explain the options.",
        "#   beamsplat run FILE      then open http://127.0.0.1:8420",
        "# To keep what is measured, add [nodes.recorder].",
        f"robot = {json.dumps(robot)}",
    ]
    for name, options in sections:
        lines += ["", f"[nodes.{name}]", *(f"{key} = {json.dumps(value)}" for key, value in options.items())]
    return "\n".join(lines) + "\n"
