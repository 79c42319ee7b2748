"""A camera as a node: its pictures in the bytes it gave, and the calibration they belong to."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.rig import RigFile, load_rig
from beamsplat.common.messages import Image, Rig
from beamsplat.common.runtime.clock import StampClock
from beamsplat.common.runtime.node import Node, Sourced
from beamsplat.services.camera.capture import CaptureSource
from beamsplat.services.camera.config import CameraConfig, NoCameraConfig
from beamsplat.services.camera.mjpeg import HttpSource, is_multipart
from beamsplat.services.camera.reader import CameraReader, CameraSource

_TIMEOUT_S = 3.0


class CameraNode(Node):
    """V4L2 devices, network streams and files. A camera that is not there yet, or gone, is waited for."""

    name = "camera"
    Config = CameraConfig
    config: CameraConfig
    outputs = ("rig", "camera/image")

    def configure(self) -> None:
        """Reads the calibration, so that what is wrong with it is said before anything runs."""
        c = self.config
        self._rig = load_rig(c.rig) if c.rig is not None else None
        if self._rig is not None and self._rig.camera is None:
            raise UserError(f'{c.rig}: has no [camera]; add it, or set kind = "none" for a robot without one')
        self._clock = StampClock()
        self._reader = CameraReader(
            self._open, size_px=self._size_px(strict=True), rate_hz=c.rate_hz, delay_s=c.delay_s,
            silence_s=c.silence_s, jpeg_quality=c.jpeg_quality,
        )  # fmt: skip

    def source(self) -> Iterator[Sourced | None]:
        """The calibration, then pictures; None while there is nothing to say."""
        if self._rig is not None:
            yield _rig_message(self._rig, self._clock.now_ns(), str(self.config.rig))
        for picture in self._reader.images():
            uncalibrated = "" if self._rig is not None else "; NO CALIBRATION, give a rig file with rig = ..."
            self.detail = self._reader.status + uncalibrated
            if picture is None:
                yield None
                continue
            image = Image(
                stamp_ns=picture.stamp_ns, width_px=picture.width_px, height_px=picture.height_px,
                encoding="jpeg", data=np.frombuffer(picture.jpeg, np.uint8),
            )  # fmt: skip
            yield Sourced(None, "camera/image", image)
        self.detail = self._reader.status

    def close(self) -> None:
        if hasattr(self, "_reader"):
            self._reader.close()

    def _open(self) -> CameraSource:
        source = self.config.source
        if source.startswith(("http://", "https://")) and is_multipart(source, _TIMEOUT_S):
            return HttpSource(source, _TIMEOUT_S, self._clock.now_ns)
        return CaptureSource(source, self._clock.now_ns, self._size_px(strict=False), self.config.rate_hz)

    def _size_px(self, *, strict: bool) -> tuple[int, int] | None:
        """Size of the calibration; for asking the camera (not `strict`) also what the options say."""
        c = self.config
        if self._rig is not None:
            return self._rig.camera.width_px, self._rig.camera.height_px
        return (c.width_px, c.height_px) if c.width_px and c.height_px and not strict else None


class NoCamera(Node):
    """Says where the lidar sits, and nothing else."""

    name = "camera"
    Config = NoCameraConfig
    config: NoCameraConfig
    outputs = ("rig",)

    def configure(self) -> None:
        self._rig = load_rig(self.config.rig)
        self._clock = StampClock()

    def source(self) -> Iterator[Sourced | None]:
        """The calibration once; it is latched. A robot without it stays without for ever: this never ends."""
        yield _rig_message(self._rig, self._clock.now_ns(), str(self.config.rig))
        while True:
            time.sleep(0.2)
            yield None


def _rig_message(rig: RigFile, stamp_ns: int, path: str) -> Sourced:
    message: Rig = rig.message(stamp_ns, rig.source or path)
    return Sourced(None, "rig", message)
