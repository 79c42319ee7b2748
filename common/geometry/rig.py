"""rig.toml: the calibration of one robot, as measured or as written by `beamsplat rig`.

    [camera]
    width_px = 640
    height_px = 480
    fx_px = 530.0
    fy_px = 530.0
    cx_px = 319.5
    cy_px = 239.5
    distortion_model = "plumb_bob"           # none, plumb_bob, rational_polynomial, equidistant
    distortion = [0.1, 0.2, 0.0, 0.0, 0.0]

    [camera.mount]                           # on the body: origin on the floor, x forward, z up
    xyz_m = [0.10, 0.0, 0.45]
    rpy_deg = [0.0, 2.0, 0.0]                # of the housing: 0 0 0 looks level and straight ahead,
                                             # positive pitch looks down, positive yaw to the left
    [lidar.mount]
    xyz_m = [0.0, 0.0, 0.18]
    quat_xyzw = [0.0, 0.0, 0.0, 1.0]

A mount gives its rotation as `rpy_deg` (R = Rz(yaw) Ry(pitch) Rx(roll)) or as a quaternion whose name
tells its order. A camera's quaternion is that of the **optical** frame (x right, y down, z forward),
as ROS gives it; its rpy is that of the housing (x forward), as one measures it.
"""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from beamsplat.common.config.base import Config, parse
from beamsplat.common.errors import UserError, reason
from beamsplat.common.geometry.frames import R_body_camera_level
from beamsplat.common.geometry.transforms import (
    make_transform,
    matrix_from_quat_wxyz,
    matrix_from_quat_xyzw,
    quat_xyzw_from_matrix,
    so3_exp,
)
from beamsplat.common.messages import CameraModel, LidarModel, Rig

Finite = Annotated[float, Field(allow_inf_nan=False)]
Metres = Annotated[float, Field(allow_inf_nan=False, ge=-100.0, le=100.0)]
Degrees = Annotated[float, Field(allow_inf_nan=False, ge=-360.0, le=360.0)]
Quat = tuple[Finite, Finite, Finite, Finite]


def rotation_from_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> np.ndarray:
    """R [3, 3] = Rz(yaw) Ry(pitch) Rx(roll): fixed axes x, y, z in turn, as in URDF."""
    x, y, z = np.eye(3)
    return so3_exp(yaw_rad * z) @ so3_exp(pitch_rad * y) @ so3_exp(roll_rad * x)


def rpy_from_rotation(R: np.ndarray) -> np.ndarray:
    """(roll, pitch, yaw) in radians of R [3, 3]; at pitch +-90 degrees roll is taken as 0."""
    pitch = float(np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])))
    if np.hypot(R[0, 0], R[1, 0]) < 1e-9:
        return np.array([0.0, pitch, np.arctan2(-R[0, 1], R[1, 1])])
    return np.array([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])


class Mount(Config):
    """Where a sensor sits on the body."""

    xyz_m: tuple[Metres, Metres, Metres]
    rpy_deg: tuple[Degrees, Degrees, Degrees] | None = None
    quat_wxyz: Quat | None = None
    quat_xyzw: Quat | None = None

    @model_validator(mode="after")
    def _one_rotation(self) -> Mount:
        given = [n for n in ("rpy_deg", "quat_wxyz", "quat_xyzw") if getattr(self, n) is not None]
        if len(given) != 1:
            raise ValueError(
                "a mount takes exactly one of rpy_deg, quat_wxyz and quat_xyzw; "
                f"given: {', '.join(given) or 'none'}"
            )
        for name in given[-1:]:
            values = getattr(self, name)
            if name != "rpy_deg" and not 0.99 < np.linalg.norm(values) < 1.01:
                raise ValueError(f"{name} = {list(values)} is not a unit quaternion")
        return self

    def transform(self, R_housing_sensor: np.ndarray) -> np.ndarray:
        """`T_body_sensor` [4, 4]; `R_housing_sensor` [3, 3] applies to rpy_deg only."""
        if self.rpy_deg is not None:
            R = rotation_from_rpy(*np.radians(self.rpy_deg)) @ R_housing_sensor
        elif self.quat_wxyz is not None:
            R = matrix_from_quat_wxyz(np.array(self.quat_wxyz))
        else:
            R = matrix_from_quat_xyzw(np.array(self.quat_xyzw))
        return make_transform(R, np.array(self.xyz_m))

    @staticmethod
    def of(T_body_sensor: np.ndarray) -> Mount:
        """Mount with the quaternion of `T_body_sensor` [4, 4]."""
        quat = quat_xyzw_from_matrix(T_body_sensor[:3, :3])
        return Mount(
            xyz_m=tuple(float(v) for v in T_body_sensor[:3, 3]), quat_xyzw=tuple(float(v) for v in quat)
        )


class CameraFile(Config):
    """[camera] of a rig file."""

    width_px: Annotated[int, Field(gt=0, le=16384)]
    height_px: Annotated[int, Field(gt=0, le=16384)]
    fx_px: Annotated[Finite, Field(gt=0.0)]
    fy_px: Annotated[Finite, Field(gt=0.0)]
    cx_px: Finite
    cy_px: Finite
    distortion_model: Literal["none", "plumb_bob", "rational_polynomial", "equidistant"] = "none"
    distortion: Annotated[tuple[Finite, ...], Field(max_length=14)] = ()
    mount: Mount

    @model_validator(mode="after")
    def _the_message_takes_it(self) -> CameraFile:
        self.model()
        return self

    def model(self) -> CameraModel:
        """The camera as the message has it; refuses K of another image size and wrong coefficient counts."""
        fields = self.model_dump(exclude={"mount"})
        return CameraModel(**fields, T_body_camera=self.mount.transform(R_body_camera_level))


class LidarFile(Config):
    """[lidar] of a rig file."""

    mount: Mount

    def model(self) -> LidarModel:
        return LidarModel(T_body_lidar=self.mount.transform(np.eye(3)))


class RigFile(Config):
    """A rig file. A robot without a camera has no [camera]; one without a lidar no [lidar]."""

    camera: CameraFile | None = None
    lidar: LidarFile | None = None
    assumed: Annotated[tuple[str, ...], Field(max_length=64)] = ()
    source: str = ""

    def message(self, stamp_ns: int, source: str) -> Rig:
        """The calibration as it goes out on the bus."""
        return Rig(
            stamp_ns=stamp_ns,
            camera=self.camera.model() if self.camera else None,
            lidar=self.lidar.model() if self.lidar else None,
            assumed=self.assumed,
            source=source,
        )

    @staticmethod
    def of(rig: Rig) -> RigFile:
        """The file that gives this calibration."""
        camera = lidar = None
        if rig.camera is not None:
            fields = {k: v for k, v in rig.camera.__dict__.items() if k != "T_body_camera"}
            camera = CameraFile(**fields, mount=Mount.of(rig.camera.T_body_camera))
        if rig.lidar is not None:
            lidar = LidarFile(mount=Mount.of(rig.lidar.T_body_lidar))
        return RigFile(camera=camera, lidar=lidar, assumed=rig.assumed, source=rig.source)


def load_rig(path: Path) -> RigFile:
    """The rig file at `path`.

    Raises:
        UserError: no such file, not TOML, unknown key, or a value that does not fit; one sentence that
            names file, field and value.
    """
    try:
        text = Path(path).read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            f"{path}: cannot be read as a rig file ({reason(error)}); `beamsplat rig` writes a first one"
        ) from error
    return parse_rig(text, str(path))


def check_rig_option(path: Path | None) -> RigFile | None:
    """Return the rig file that an option `rig` names, None where it names none.

    Raises:
        UserError: as `load_rig`, naming the option.
    """
    try:
        return None if path is None else load_rig(path)
    except UserError as error:
        raise UserError(f"rig = {error}") from error


def parse_rig(text: str, where: str) -> RigFile:
    """The rig file with this text; `where` names it in errors (see `load_rig`)."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{where}: not a TOML file: {reason(error)}") from error
    rig = parse(RigFile, table, where)
    if rig.camera is None and rig.lidar is None:
        raise UserError(f"{where}: has neither [camera] nor [lidar]; give at least one")
    return rig


def write_rig(path: Path, text: str) -> None:
    """Writes a rig file that has been formatted by `format_rig`; a reader never sees half of it."""
    partial = Path(path).with_name(Path(path).name + ".partial")
    partial.write_text(text)
    os.replace(partial, path)


def format_rig(rig: RigFile, header: str, notes: dict[str, str]) -> str:
    """TOML text of a rig. `notes` puts a comment above "camera", "camera.mount" and "lidar.mount"."""
    lines = [f"# {line}".rstrip() for line in header.splitlines()]
    lines += [f"source = {_toml(rig.source)}"]
    if rig.assumed:
        lines += ["assumed = [", *(f"  {_toml(text)}," for text in rig.assumed), "]"]
    if rig.camera is not None:
        lines += ["", *_comment(notes.get("camera", "")), "[camera]"]
        for name, value in rig.camera.model_dump(exclude={"mount"}).items():
            lines.append(f"{name} = {_toml(value)}")
        lines += _mount_lines("camera", rig.camera.mount, R_body_camera_level, notes)
    if rig.lidar is not None:
        lines += _mount_lines("lidar", rig.lidar.mount, np.eye(3), notes)
    return "\n".join(lines) + "\n"


def _mount_lines(sensor: str, mount: Mount, R_housing_sensor: np.ndarray, notes: dict[str, str]) -> list[str]:
    R_body_housing = mount.transform(R_housing_sensor)[:3, :3] @ R_housing_sensor.T
    rpy_deg = np.degrees(rpy_from_rotation(R_body_housing)) + 0.0
    lines = ["", *_comment(notes.get(f"{sensor}.mount", "")), f"[{sensor}.mount]"]
    lines.append(f"xyz_m = {_toml([round(v, 9) for v in mount.xyz_m])}")
    lines.append(f"rpy_deg = {_toml([round(float(v), 9) + 0.0 for v in rpy_deg])}")
    return lines


def _comment(text: str) -> list[str]:
    return [f"# {line}".rstrip() for line in text.splitlines()]


def _toml(value: object) -> str:
    if isinstance(value, str):
        escaped = "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in value)
        return f'"{escaped}"'
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(entry) for entry in value) + "]"
    return repr(value)
