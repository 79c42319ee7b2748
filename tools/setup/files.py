"""The two files that setup writes: robot.toml, the deployment, and rig.toml, the calibration."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from beamsplat.common.geometry.frames import camera_mount, lidar_mount
from beamsplat.common.geometry.rig import CameraSection, LidarSection, Mount, RigFile, format_rig
from beamsplat.tools.setup.lens import Lens

_HEADER = """Calibration of one robot, by `beamsplat setup`: where camera and lidar sit, how the camera sees.
The body frame lies on the floor between the wheels: x forward, y left, z up. Metres and degrees.
rpy_deg = [roll, pitch, yaw]: zero is level and straight ahead; positive pitch looks down,
positive yaw to the left."""


@dataclass(frozen=True)
class Place:
    """Where a sensor sits, as one measures it with a tape."""

    forward_m: float
    left_m: float
    up_m: float
    down_deg: float = 0.0  # how far it looks down
    left_deg: float = 0.0  # how far it is turned to the left

    def camera(self) -> np.ndarray:
        """`T_body_camera` [4, 4]."""
        return camera_mount(self.forward_m, self.left_m, self.up_m, pitch_down_rad=np.radians(self.down_deg))

    def lidar(self) -> np.ndarray:
        """`T_body_lidar` [4, 4]."""
        return lidar_mount(self.forward_m, self.left_m, self.up_m, yaw_left_rad=np.radians(self.left_deg))


def camera_file(lens: Lens, T_body_camera: np.ndarray) -> CameraSection:
    """[camera] of a calibrated lens."""
    K = np.round(lens.K, 4)
    return CameraSection(
        width_px=lens.size_px[0], height_px=lens.size_px[1], fx_px=float(K[0, 0]), fy_px=float(K[1, 1]),
        cx_px=float(K[0, 2]), cy_px=float(K[1, 2]), distortion_model="plumb_bob",
        distortion=tuple(round(float(v), 6) for v in lens.distortion), mount=Mount.of(T_body_camera),
    )  # fmt: skip


def rig_text(camera: CameraSection | None, T_body_lidar: np.ndarray, assumed: tuple[str, ...], note: str) -> str:
    """Text of rig.toml; `note` says how the camera was calibrated."""
    rig = RigFile(
        camera=camera,
        lidar=LidarSection(mount=Mount.of(T_body_lidar)),
        assumed=assumed,
        source="beamsplat setup",
    )
    return format_rig(rig, _HEADER, {"camera": note})


def robot_text(robot: str, rig: str, camera: dict[str, Any] | None, lidar: dict[str, Any]) -> str:
    """Text of robot.toml: the sensors' nodes with these options, and what makes a map of them."""
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
