"""Options of the replay service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig

SensorName = Literal["image", "scan", "odometry", "pose"]


class ReplayConfig(NodeConfig):
    """Options of replay: data and topics. The speed is the option `rate` of the deployment."""

    data: Path  # a bag, a recording, a folder
    start_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    duration_s: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] | None = None
    loop: bool = False
    rig: Path | None = None  # calibration; overrides that of the data
    image_topic: str = ""  # if several topics have the right type
    scan_topic: str = ""
    odometry_topic: str = ""
    pose_topic: str = ""
    camera_info_topic: str = ""
    body_frame: str = ""  # name of the body frame, if unusual
    without: tuple[SensorName, ...] = ()  # sensors to leave out
    require: tuple[SensorName, ...] = ("scan",)  # sensors without which the data are rejected
    assume_mounts: bool = False  # assume usual mounts where there are none; listed in the calibration
    allow_truncated: bool = False  # use the readable part of a truncated bag
