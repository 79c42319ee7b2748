"""A frame as a camera source delivers it, and the errors of sources."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


class CameraError(OSError):
    """The camera cannot be opened or no longer delivers; the text says why."""


class CameraEnded(CameraError):
    """The end of a video file."""


@dataclass(frozen=True)
class CapturedFrame:
    """One frame of a source: either JPEG bytes or pixels."""

    stamp_ns: int  # capture time on the sensors' clock
    jpeg: bytes | None  # unchanged from the camera
    bgr: np.ndarray | None  # uint8 [H, W, 3], if the camera delivers no JPEG
