"""Options of the camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig, Seconds


class NoCameraConfig(NodeConfig):
    """Options of a robot without a camera; its rig file contains the pose of the lidar."""

    rig: Path


class CameraConfig(NodeConfig):
    """Options of one camera that can be read with OpenCV or over HTTP."""

    source: str = "0"  # number or path of a V4L2 device, rtsp:// or http:// address, video file
    rig: Path | None = None  # calibration; images of another size than its K are rejected
    width_px: Annotated[int, Field(ge=0, le=16384)] = 0  # 0: size of the rig, else the camera's own
    height_px: Annotated[int, Field(ge=0, le=16384)] = 0
    rate_hz: Remote[Annotated[float, Field(ge=0.0, le=1000.0)]] = 0.0  # requested; 0: the camera's own
    jpeg_quality: Remote[Annotated[int, Field(ge=1, le=100)]] = 92  # used where the source delivers no JPEG
    delay_s: Seconds = 0.0  # from exposure to arrival, as measured; subtracted from the time stamps
    silence_s: Remote[Annotated[float, Field(gt=0.0, le=60.0)]] = 2.0  # without an image: reconnect
