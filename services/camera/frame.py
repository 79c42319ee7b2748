"""One frame of a camera source, and the errors of camera sources."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


class CameraError(OSError):
    """Error: the camera cannot be opened or returns no more images; the text contains the reason."""


class CameraEnded(CameraError):
    """Signal that the end of a video file is reached."""


@dataclass(frozen=True)
class CapturedFrame:
    """One frame of a source: either JPEG bytes or pixels."""

    stamp_ns: int  # capture time on the sensors' clock
    jpeg: bytes | None  # unchanged from the camera
    bgr: np.ndarray | None  # uint8 [H, W, 3], if the camera delivers no JPEG
