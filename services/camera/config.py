"""Options of the camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig, Seconds


class NoCameraConfig(NodeConfig):
    """A robot without a camera still has a calibration: where its lidar sits."""

    rig: Path


class CameraConfig(NodeConfig):
    """One camera, as OpenCV or plain HTTP reaches it."""

    source: str = "0"  # number or path of a V4L2 device, rtsp:// or http:// address, video file
    rig: Path | None = None  # calibration; pictures of another size than its K are refused
    width_px: Annotated[int, Field(ge=0, le=16384)] = 0  # 0: as the rig says, else as the camera comes
    height_px: Annotated[int, Field(ge=0, le=16384)] = 0
    rate_hz: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0  # asked for; 0: as the camera comes
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 92  # where the source gives no JPEG of its own
    delay_s: Seconds = 0.0  # from exposure to arrival, where nobody but a measurement can tell
    silence_s: Annotated[float, Field(gt=0.0, le=60.0)] = 2.0  # without a picture so long, it counts as gone
