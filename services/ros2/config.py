"""Options of the way from and to ROS 2."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig

Word = Literal["image", "scan", "odometry", "pose"]
Domain = Annotated[int, Field(ge=0, le=232)]


def _domain() -> int:
    """As ROS has it: ROS_DOMAIN_ID, else 0."""
    text = os.environ.get("ROS_DOMAIN_ID", "")
    return int(text) if text.isdigit() else 0


ROUTER = "tcp/127.0.0.1:7447"  # where rmw_zenohd listens, and our own router


class Ros2Config(NodeConfig):
    """What to take from the robot. Everything but the domain is found out."""

    domain: Domain = Field(default_factory=_domain, validate_default=True)
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


class Ros2OutConfig(NodeConfig):
    """What to give back. An empty topic name leaves it out."""

    domain: Domain = Field(default_factory=_domain, validate_default=True)
    router: str = ROUTER
    pose_topic: str = "/beamsplat/pose"
    cloud_topic: str = "/beamsplat/cloud"
    map_topic: str = "/map"
    tf: bool = True  # map -> odom, and odom -> body where the robot has no odometry of its own
    map_frame: str = "map"
    odom_frame: str = "odom"
    body_frame: str = "base_link"
