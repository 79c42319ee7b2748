"""The rig file rig.toml: camera intrinsics and sensor mounts of one robot, by hand or from `beamsplat rig`.

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

    [lidar.scan]                             # optional: how the driver reports its beams (common/scans)
    order = "reversed"                       # forward, reversed, none (all at once)
    sweep_s = 0.1                            # time from the first beam to the last
    stamp = "first"                          # first, last: the beam whose time the stamp is

The rotation of a mount is `rpy_deg` (R = Rz(yaw) Ry(pitch) Rx(roll)), or a quaternion in the order that its
name states. For a camera, the quaternion is the orientation of the **optical** frame (x right, y down, z
forward), as in ROS, but rpy_deg is the orientation of the housing (x forward), which is easy to measure.
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
from beamsplat.common.files.persist import read_limited
from beamsplat.common.geometry.frames import R_body_camera_level
from beamsplat.common.geometry.transforms import (
    make_transform,
    matrix_from_quat_wxyz,
    matrix_from_quat_xyzw,
    quat_xyzw_from_matrix,
    so3_exp,
)
from beamsplat.common.messages import CameraModel, LidarModel, Rig

_MAX_BYTES = 1_000_000  # of a rig file; usual ones have about 1 kB
Finite = Annotated[float, Field(allow_inf_nan=False)]
Metres = Annotated[float, Field(allow_inf_nan=False, ge=-100.0, le=100.0)]
Degrees = Annotated[float, Field(allow_inf_nan=False, ge=-360.0, le=360.0)]
Quat = tuple[Finite, Finite, Finite, Finite]


def rotation_from_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> np.ndarray:
    """Return R [3, 3] = Rz(yaw) Ry(pitch) Rx(roll), rotations about fixed axes as in URDF."""
    x, y, z = np.eye(3)
    return so3_exp(yaw_rad * z) @ so3_exp(pitch_rad * y) @ so3_exp(roll_rad * x)


def rpy_from_rotation(R: np.ndarray) -> np.ndarray:
    """Return (roll, pitch, yaw) in radians of R [3, 3]; at pitch +-90 degrees (gimbal lock) roll is 0."""
    pitch = float(np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])))
    if np.hypot(R[0, 0], R[1, 0]) < 1e-9:
        return np.array([0.0, pitch, np.arctan2(-R[0, 1], R[1, 1])])
    return np.array([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])


class Mount(Config):
    """Position (m) and orientation of a sensor in the body frame, as written in a rig file."""

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
        """Return `T_body_sensor` [4, 4].

        `R_housing_sensor` [3, 3] is applied to `rpy_deg` only: a quaternion describes the sensor frame
        itself.
        """
        if self.rpy_deg is not None:
            R = rotation_from_rpy(*np.radians(self.rpy_deg)) @ R_housing_sensor
        elif self.quat_wxyz is not None:
            R = matrix_from_quat_wxyz(np.array(self.quat_wxyz))
        else:
            R = matrix_from_quat_xyzw(np.array(self.quat_xyzw))
        return make_transform(R, np.array(self.xyz_m))

    @staticmethod
    def of(T_body_sensor: np.ndarray) -> Mount:
        """Return the mount of a `T_body_sensor` [4, 4], with a quaternion."""
        quat = quat_xyzw_from_matrix(T_body_sensor[:3, :3])
        return Mount(
            xyz_m=tuple(float(v) for v in T_body_sensor[:3, 3]), quat_xyzw=tuple(float(v) for v in quat)
        )


class CameraSection(Config):
    """The [camera] section of a rig file."""

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
    def _is_valid_message(self) -> CameraSection:
        self.model()
        return self

    def model(self) -> CameraModel:
        """Return the camera model of the `Rig` message.

        Raises:
            ValidationError: K belongs to another image size, or the number of coefficients is wrong.
        """
        fields = self.model_dump(exclude={"mount"})
        return CameraModel(**fields, T_body_camera=self.mount.transform(R_body_camera_level))


class ScanSection(Config):
    """The [lidar.scan] section: how the driver of the lidar reports its beams; what is not set is found out.

    BeamSplat finds these values from the data (common/scans) and `beamsplat rig` writes them.
    """

    order: Literal["forward", "reversed", "none"] | None = None  # of the beams in time; none: all at once
    sweep_s: Annotated[Finite, Field(ge=0.0, le=10.0)] | None = None  # time from the first beam to the last
    stamp: Literal["first", "last"] | None = None  # the stamp is the time of this beam, in the order of time
    angles: Literal["increment", "limits", "from_max", "to_max"] | None = (
        None  # which of contradicting fields holds
    )
    mirrored: bool | None = None  # whether the directions of the beams change sign


class LidarSection(Config):
    """The [lidar] section of a rig file."""

    mount: Mount
    scan: ScanSection | None = None

    def model(self) -> LidarModel:
        """Return the lidar model of the `Rig` message."""
        return LidarModel(T_body_lidar=self.mount.transform(np.eye(3)))


class RigFile(Config):
    """A rig file. A robot without a camera has no [camera] section; one without a lidar has no [lidar]."""

    camera: CameraSection | None = None
    lidar: LidarSection | None = None
    assumed: Annotated[tuple[str, ...], Field(max_length=64)] = ()  # a sentence for each assumed value
    source: str = ""  # where the calibration comes from

    def message(self, stamp_ns: int, source: str) -> Rig:
        """Return the calibration as a `Rig` message."""
        return Rig(
            stamp_ns=stamp_ns,
            camera=self.camera.model() if self.camera else None,
            lidar=self.lidar.model() if self.lidar else None,
            assumed=self.assumed,
            source=source,
        )

    @staticmethod
    def of(rig: Rig) -> RigFile:
        """Return the rig file of a calibration message."""
        camera = lidar = None
        if rig.camera is not None:
            fields = {k: v for k, v in rig.camera.__dict__.items() if k != "T_body_camera"}
            camera = CameraSection(**fields, mount=Mount.of(rig.camera.T_body_camera))
        if rig.lidar is not None:
            lidar = LidarSection(mount=Mount.of(rig.lidar.T_body_lidar))
        return RigFile(camera=camera, lidar=lidar, assumed=rig.assumed, source=rig.source)


def load_rig(path: Path) -> RigFile:
    """Read and validate the rig file at `path`.

    Raises:
        UserError: the file is missing, too long, not TOML, or has an unknown key or an invalid value; the
            text names file, field and value.
    """
    try:
        text = read_limited(Path(path), _MAX_BYTES).decode()
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path}: cannot be read as a rig file ({reason(error)}); create one with `beamsplat rig`"
        ) from error
    return parse_rig(text, str(path))


def check_rig_option(path: Path | None) -> RigFile | None:
    """Read the rig file at the path in a node's option `rig`; return None if the option is not set.

    Raises:
        UserError: as `load_rig`; the text also contains the name of the option.
    """
    try:
        return None if path is None else load_rig(path)
    except UserError as error:
        raise UserError(f"rig = {error}") from error


def parse_rig(text: str, where: str) -> RigFile:
    """Parse and validate the text of a rig file (see `load_rig`); `where` is its source, for error texts."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{where}: not a TOML file: {reason(error)}") from error
    rig = parse(RigFile, table, where)
    if rig.camera is None and rig.lidar is None:
        raise UserError(f"{where}: has neither [camera] nor [lidar]; add at least one")
    return rig


def write_rig(path: Path, text: str) -> None:
    """Write `text` (result of `format_rig`) to `path` atomically: the file is never incomplete."""
    partial = Path(path).with_name(Path(path).name + ".partial")
    partial.write_text(text)
    os.replace(partial, path)


def format_rig(rig: RigFile, header: str, notes: dict[str, str]) -> str:
    """Return the TOML text of a rig file.

    Args:
        rig: the calibration; mounts are written as rpy_deg.
        header: comment at the top.
        notes: comments above the sections "camera", "camera.mount", "lidar.mount" and "lidar.scan".
    """
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
        if rig.lidar.scan is not None:
            lines += ["", *_comment(notes.get("lidar.scan", "")), "[lidar.scan]"]
            lines += [
                f"{name} = {_toml(value)}"
                for name, value in rig.lidar.scan.model_dump(exclude_none=True).items()
            ]
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
    return str(value).lower() if isinstance(value, bool) else repr(value)
