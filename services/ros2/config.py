"""Options of the node that receives data from a ROS 2 robot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.config.ros import ROUTER, Domain, domain_field

SensorKind = Literal["image", "scan", "odometry", "pose"]


class Ros2Config(NodeConfig):
    """Options of the ROS 2 source. Topics and calibration that are not set are found automatically."""

    domain: Domain = domain_field()
    router: str = ROUTER  # the router that the robot's nodes use
    image_topic: str = (
        ""  # needed only if several topics have the type of an image; the same holds for the following
    )
    scan_topic: str = ""
    odometry_topic: str = ""
    pose_topic: str = ""
    camera_info_topic: str = ""
    body_frame: str = ""
    rig: Path | None = None  # calibration; replaces the one that the robot publishes
    without: tuple[SensorKind, ...] = ()  # sensors to ignore
    assume_mounts: bool = False  # use default mounts where the robot publishes no transforms
    settle_s: Annotated[float, Field(ge=0.0, le=60.0)] = 2.0  # from the first message to topic selection
