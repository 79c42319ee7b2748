"""The camera node: publishes the camera's JPEG images unchanged, and the calibration of the camera."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.rig import RigFile, check_rig_option, load_rig
from beamsplat.common.messages import Image, Rig
from beamsplat.common.runtime.clock import StampClock
from beamsplat.common.runtime.node import Node, SourceItem
from beamsplat.services.camera.capture import CaptureSource
from beamsplat.services.camera.config import CameraConfig, NoCameraConfig
from beamsplat.services.camera.mjpeg import HttpSource, is_multipart
from beamsplat.services.camera.reader import CameraReader, CameraSource

_TIMEOUT_S = 3.0  # for HTTP cameras: connection and each read


class CameraNode(Node):
    """Reads V4L2 devices, network streams and files; reconnects to a camera that is missing or fails."""

    name = "camera"
    Config = CameraConfig
    config: CameraConfig
    outputs = ("rig", "camera/image")

    def configure(self) -> None:
        """Read the calibration, so that an error in the rig file is reported before the system starts."""
        c = self.config
        self._rig = load_rig(c.rig) if c.rig is not None else None
        if self._rig is not None and self._rig.camera is None:
            raise UserError(
                f'{c.rig}: [camera] is missing; add it, or set kind = "none" if there is no camera'
            )
        self._clock = StampClock()
        self._reader = CameraReader(
            self._open, size_px=self._size_px(strict=True), rate_hz=c.rate_hz, delay_s=c.delay_s,
            silence_s=c.silence_s, jpeg_quality=c.jpeg_quality,
        )  # fmt: skip

    def check_resources(self) -> None:
        """Check that the rig file contains a camera, and that `source`, if it is a file, exists."""
        c = self.config
        rig = check_rig_option(c.rig)
        if rig is not None and rig.camera is None:
            raise UserError(f"rig = {c.rig}: [camera] is missing")
        is_file = not c.source.isdigit() and "://" not in c.source and not c.source.startswith("/dev/")
        if is_file and not Path(c.source).is_file():  # devices and streams may be connected later
            raise UserError(
                f"source = {c.source!r}: no such file (a source is a number, a device, an address or a file)"
            )

    def source(self) -> Iterator[SourceItem | None]:
        """Yield the calibration, then images; None while no image is available."""
        if self._rig is not None:
            yield _rig_message(self._rig, self._clock.now_ns(), str(self.config.rig))
        for checked in self._reader.images():
            uncalibrated = "" if self._rig is not None else "; NO CALIBRATION: set a rig file with rig = ..."
            self.detail = self._reader.status + uncalibrated
            self.rejections.set("images overtaken by newer ones", self._reader.dropped)
            for reason, count in self._reader.rejected.items():
                self.rejections.set(f"images rejected: {reason}", count)
            if checked is None:
                yield None
                continue
            image = Image(
                stamp_ns=checked.stamp_ns, width_px=checked.width_px, height_px=checked.height_px,
                encoding="jpeg", data=np.frombuffer(checked.jpeg, np.uint8),
            )  # fmt: skip
            yield SourceItem(None, "camera/image", image)
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
        """Return the image size (width, height), px, of the calibration; None if it is unknown.

        If `strict` is False, the options `width_px` and `height_px` are used where there is no calibration.
        """
        c = self.config
        if self._rig is not None and self._rig.camera is not None:
            return self._rig.camera.width_px, self._rig.camera.height_px
        return (c.width_px, c.height_px) if c.width_px and c.height_px and not strict else None


class NoCamera(Node):
    """Publishes the calibration (`rig`) of a robot without a camera."""

    name = "camera"
    Config = NoCameraConfig
    config: NoCameraConfig
    outputs = ("rig",)

    def configure(self) -> None:
        self._rig = load_rig(self.config.rig)
        self._clock = StampClock()

    def check_resources(self) -> None:
        check_rig_option(self.config.rig)

    def source(self) -> Iterator[SourceItem | None]:
        """Yield the calibration once, because the topic is latched; then None, without end."""
        yield _rig_message(self._rig, self._clock.now_ns(), str(self.config.rig))
        while True:
            time.sleep(0.2)
            yield None


def _rig_message(rig: RigFile, stamp_ns: int, path: str) -> SourceItem:
    message: Rig = rig.message(stamp_ns, rig.source or path)
    return SourceItem(None, "rig", message)
