"""Options of the lidar drivers."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig

Metres = Annotated[float, Field(gt=0.0, le=1000.0, allow_inf_nan=False)]


class LidarConfig(NodeConfig):
    """What all lidars have in common."""

    device: str = "/dev/ttyUSB0"  # a serial port, best by its name in /dev/serial/by-id; or tcp/HOST:PORT
    baud: Annotated[int, Field(ge=0)] = 0  # 0: tries those that this kind of lidar comes with
    upside_down: bool = False  # mounted head down: directions run the other way round
    range_min_m: Metres | None = None  # nearer readings are left to the consumers; default: the device's own
    range_max_m: Metres | None = None


class RplidarConfig(LidarConfig):
    """SLAMTEC RPLIDAR."""

    mode: Literal["auto", "express", "standard"] = "auto"


class HokuyoConfig(LidarConfig):
    """Hokuyo, SCIP 2."""

    device: str = "tcp/192.168.0.10:10940"  # as Hokuyo's network lidars come; USB ones are /dev/ttyACM0
    intensity: bool = False
