"""One picture on its way from a camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


class CameraError(OSError):
    """The camera is not there, or no longer; the text says what is known."""


class CameraEnded(CameraError):
    """A file has been shown to its end."""


@dataclass(frozen=True)
class CapturedFrame:
    """What a source delivered."""

    stamp_ns: int
    jpeg: bytes | None  # as the camera gave it
    bgr: np.ndarray | None  # uint8 [H, W, 3], where it gave no JPEG
