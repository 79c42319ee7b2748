"""Options of the replay service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig

Word = Literal["image", "scan", "odometry", "pose"]


class ReplayConfig(NodeConfig):
    """What to play, and what of it. How fast is the deployment's `rate`."""

    data: Path  # a bag, a recording, a folder
    start_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    duration_s: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] | None = None
    loop: bool = False
    rig: Path | None = None  # calibration; wins over what the data say
    image_topic: str = ""  # where several topics are of the right type
    scan_topic: str = ""
    odometry_topic: str = ""
    pose_topic: str = ""
    camera_info_topic: str = ""
    body_frame: str = ""  # the robot's own frame, where its name is unusual
    without: tuple[Word, ...] = ()  # leave these out
    require: tuple[Word, ...] = ("scan",)  # refuse data without these
    assume_mounts: bool = False  # guess where unplaced sensors sit, and say so in the calibration
    allow_truncated: bool = False  # use what is there of a bag that was cut off
