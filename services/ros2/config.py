"""Options of the node that subscribes to a ROS 2 robot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.config.ros import ROUTER, Domain, domain_field

Word = Literal["image", "scan", "odometry", "pose"]


class Ros2Config(NodeConfig):
    """What to take from the robot. Everything but the domain is found out."""

    domain: Domain = domain_field()
    router: str = ROUTER  # the router that the robot's nodes use
    image_topic: str = ""  # where several topics are of the right type
    scan_topic: str = ""
    odometry_topic: str = ""
    pose_topic: str = ""
    camera_info_topic: str = ""
    body_frame: str = ""
    rig: Path | None = None  # calibration; wins over what the robot says
    without: tuple[Word, ...] = ()
    assume_mounts: bool = False
    settle_s: Annotated[float, Field(ge=0.0, le=60.0)] = 2.0
