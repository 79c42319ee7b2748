"""Options of the lidar drivers."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig

Metres = Annotated[float, Field(gt=0.0, le=1000.0, allow_inf_nan=False)]


class LidarConfig(NodeConfig):
    """Options common to all lidars."""

    device: str = "/dev/ttyUSB0"  # serial port, best by its link in /dev/serial/by-id; or tcp/HOST:PORT
    baud: Annotated[int, Field(ge=0)] = 0  # 0: try the rates that this kind of lidar uses
    upside_down: bool = False  # mounted upside down: the angles change sign
    range_min_m: Remote[Metres | None] = None  # published with each scan; default: the device's own
    range_max_m: Remote[Metres | None] = None  # farther readings become NaN; default: the device's own


class RplidarConfig(LidarConfig):
    """Options of SLAMTEC RPLIDAR devices."""

    mode: Literal["auto", "express", "standard"] = "auto"


class HokuyoConfig(LidarConfig):
    """Options of Hokuyo lidars (SCIP 2)."""

    device: str = "tcp/192.168.0.10:10940"  # factory setting of network models; USB models: /dev/ttyACM0
    intensity: Remote[bool] = False
