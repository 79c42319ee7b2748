"""Source of frames from cameras, network streams and video files, read with OpenCV (V4L2, RTSP, files)."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from beamsplat.services.camera.frame import CameraEnded, CameraError, CapturedFrame

_TIMEOUT_MS = 3000  # for opening a stream, and for each read
_KERNEL_AGE_S = 2.0  # an older (or negative) kernel time stamp is not on the monotonic clock and is ignored


class CaptureSource:
    """An open `cv2.VideoCapture`.

    JPEG bytes of the device or file are returned without decoding, where OpenCV can read them.
    """

    def __init__(
        self, source: str, now_ns: Callable[[], int], size_px: tuple[int, int] | None, rate_hz: float
    ) -> None:
        """Open the source.

        Args:
            source: V4L2 number or path, stream address, or path of a video file.
            now_ns: returns the present time on the clock of the stamps, ns.
            size_px: (width, height) to request from a V4L2 device; None = the device's default.
            rate_hz: frame rate to request from a V4L2 device; 0 = the device's default.

        Raises:
            CameraError: the source does not exist, permission is denied, or OpenCV cannot read it.
        """
        self._now_ns = now_ns
        self._device = _device_number(source)
        self._file = self._device is None and "://" not in source
        self.where = f"/dev/video{self._device}" if self._device is not None else source.split("@")[-1]
        if self._device is not None:
            _check_device(Path(self.where))
            self._capture = cv2.VideoCapture(self._device, cv2.CAP_V4L2)
            self._set(size_px, rate_hz)
        else:
            if self._file and not Path(source).is_file():
                raise CameraError(f"{source}: no such file")
            options = [
                cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                _TIMEOUT_MS,
                cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                _TIMEOUT_MS,
            ]
            self._capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, options)
        if not self._capture.isOpened():
            self._capture.release()
            raise CameraError(
                f"{self.where} cannot be opened: another program uses it, or it is not a camera"
            )
        if self._device is None and _fourcc(self._capture) == "MJPG":
            self._capture.set(cv2.CAP_PROP_FORMAT, -1)  # return the packets without decoding
        self._fps = self._capture.get(cv2.CAP_PROP_FPS)
        self._due = time.monotonic()

    def read(self) -> CapturedFrame:
        """Return the next frame; frames of a file are returned at the frame rate of the file.

        Raises:
            CameraEnded: the end of a file.
            CameraError: the device or stream returns no more frames.
        """
        good, data = self._capture.read()
        stamp_ns = self._stamp_ns()
        if not good or data is None or not data.size:
            if self._file:
                raise CameraEnded(f"{self.where}: end of file")
            raise CameraError(f"{self.where} delivers no more images")
        if self._file and 0.0 < self._fps <= 1000.0:
            self._due += 1.0 / self._fps
            time.sleep(max(0.0, self._due - time.monotonic()))
            stamp_ns = self._now_ns()
        if data.ndim < 3 or 1 in data.shape[:2]:
            return CapturedFrame(stamp_ns, data.tobytes(), None)
        return CapturedFrame(stamp_ns, None, np.ascontiguousarray(data))

    def close(self) -> None:
        """Release the device."""
        self._capture.release()

    def _set(self, size_px: tuple[int, int] | None, rate_hz: float) -> None:
        """Request JPEG, image size and frame rate from the device.

        JPEG is requested first, because raw images at full rate exceed the bandwidth of USB. A setting that
        the device rejects has no effect.
        """
        self._capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
        if size_px is not None:
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size_px[0])
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size_px[1])
        if rate_hz:
            self._capture.set(cv2.CAP_PROP_FPS, rate_hz)
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 2)
        if _fourcc(self._capture) == "MJPG":
            self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)

    def _stamp_ns(self) -> int:
        """Return the capture time (ns): V4L2's stamp on the kernel's monotonic clock, else the time now."""
        now_ns = self._now_ns()
        if self._device is None:
            return now_ns
        age_s = time.monotonic() - self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
        return now_ns - round(age_s * 1e9) if 0.0 <= age_s < _KERNEL_AGE_S else now_ns


def _device_number(source: str) -> int | None:
    """Return the number of a V4L2 device ("0", "/dev/video0" or a link to it); None for other sources."""
    if source.isdigit():
        return int(source)
    if source.startswith("/dev/"):
        name = Path(source).resolve().name
        if name.startswith("video") and name[5:].isdigit():
            return int(name[5:])
        raise CameraError(f"{source}: no such camera")
    return None


def _check_device(path: Path) -> None:
    if not path.exists():
        raise CameraError(f"{path}: no such camera")
    if not os.access(path, os.R_OK | os.W_OK):
        raise CameraError(
            f"this user has no permission to open {path}: run `sudo usermod -aG video $USER`, then log in "
            "again (`beamsplat doctor` explains)"
        )


def _fourcc(capture: cv2.VideoCapture) -> str:
    return int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=False).decode("latin-1").upper()
