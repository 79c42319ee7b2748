"""Reader of a camera: reads in a separate thread, reconnects after a failure, checks each image.

Only complete images with the size of the calibration are returned.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

import cv2

from beamsplat.common.messages.image_header import read_image_header
from beamsplat.services.camera.frame import CameraEnded, CameraError, CapturedFrame
from beamsplat.services.camera.jpeg import is_intact

_POLL_S = 0.1
_MAX_REASONS = 16  # for which rejected images are counted separately
_RETRY_S = 0.5  # between attempts to open the camera
_RATE_S = 4.0  # window over which the frame rate is measured
_SLOW = 0.6  # ratio to the requested rate below which the status says SLOW
_MIN_OPEN_TIMEOUT_S = 5.0  # for the first image: network cameras start slowly


class CameraSource(Protocol):
    """Interface of an open camera."""

    where: str

    def read(self) -> CapturedFrame:
        """Wait for the next frame and return it. Raises CameraError."""

    def close(self) -> None:
        """Release the camera."""


class CheckedImage(NamedTuple):
    """A JPEG image that is complete and has the size of the calibration."""

    stamp_ns: int
    width_px: int
    height_px: int
    jpeg: bytes


class CameraReader:
    """Yields checked images of one camera until it is closed or a file ends; `status` is one line of text."""

    def __init__(
        self,
        open_source: Callable[[], CameraSource],
        *,
        size_px: tuple[int, int] | None,  # of the calibration; images of another size are rejected
        rate_hz: float = 0.0,  # requested rate; below 0.6 of it the status says SLOW
        delay_s: float = 0.0,
        silence_s: float = 2.0,
        jpeg_quality: int = 92,
    ) -> None:
        self._open_source = open_source
        self._size_px = size_px
        self._rate_hz = rate_hz
        self._delay_ns = round(delay_s * 1e9)
        self._silence_s = silence_s
        self._quality = jpeg_quality
        self._arrivals: deque[float] = deque()
        self._newest_ns = 0
        self._closed = False
        self._thread: _CaptureThread | None = None
        self.rejected: Counter[str] = Counter()
        self.sent = 0
        self.dropped = 0
        self.reconnects = -1
        self.status = "not opened yet"

    def images(self) -> Iterator[CheckedImage | None]:
        """Yield images as they arrive; None if no image arrived for a short time."""
        while not self._closed:
            thread = self._thread = _CaptureThread(self._open_source)
            try:
                yield from self._read_images(thread)
            except CameraEnded as error:
                self.status = f"{error}: {self._counts()}"
                return
            except CameraError as error:
                state = "DISCONNECTED" if thread.opened else "NOT CONNECTED"
                self.status = f"{state}: {error}; {self._counts()}"
            finally:
                thread.stop()
            until = time.monotonic() + _RETRY_S
            while time.monotonic() < until and not self._closed:
                yield None
                time.sleep(_POLL_S)

    def close(self) -> None:
        """Stop reading; the camera is released after the present read."""
        self._closed = True
        if self._thread is not None:
            self._thread.stop()

    def _read_images(self, thread: _CaptureThread) -> Iterator[CheckedImage | None]:
        last_frame_s = time.monotonic()
        counted = False
        while True:
            frame = thread.take(_POLL_S)
            self.dropped += thread.take_dropped_count()
            now = time.monotonic()
            if frame is None:
                timeout_s = self._silence_s if thread.opened else max(self._silence_s, _MIN_OPEN_TIMEOUT_S)
                if now - last_frame_s > timeout_s:
                    raise CameraError(f"no image for {timeout_s:g} s")
                yield None
                continue
            if not counted:
                counted = True
                self.reconnects += 1
            last_frame_s = now
            self._record_arrival(now)
            image = self._check(frame)
            self._update_status(thread.where)
            yield image

    def _check(self, frame: CapturedFrame) -> CheckedImage | None:
        """Return the image if all checks pass; otherwise count the reason and return None."""
        jpeg = frame.jpeg
        if jpeg is None:
            assert frame.bgr is not None  # a frame has one of both
            good, data = cv2.imencode(".jpg", frame.bgr, [cv2.IMWRITE_JPEG_QUALITY, self._quality])
            if not good:
                self._reject("cannot be written as JPEG")
                return None
            jpeg = data.tobytes()
        elif not is_intact(jpeg):
            self._reject("damaged")
            return None
        head = read_image_header(jpeg)
        if head is None or head.encoding != "jpeg":
            self._reject("not a JPEG")
            return None
        if self._size_px is not None and (head.width_px, head.height_px) != self._size_px:
            wanted = f"{self._size_px[0]}x{self._size_px[1]}"
            self._reject(f"{head.width_px}x{head.height_px} px, the calibration is for {wanted}")
            return None
        self._newest_ns = max(frame.stamp_ns - self._delay_ns, self._newest_ns + 1)
        self.sent += 1
        return CheckedImage(self._newest_ns, head.width_px, head.height_px, jpeg)

    def _reject(self, reason: str) -> None:
        if reason not in self.rejected and len(self.rejected) >= _MAX_REASONS:  # images of ever other sizes
            reason = "other"
        self.rejected[reason] += 1

    def _record_arrival(self, now: float) -> None:
        self._arrivals.append(now)
        while self._arrivals[0] < now - _RATE_S:
            self._arrivals.popleft()

    def _update_status(self, where: str) -> None:
        count = len(self._arrivals)
        span = self._arrivals[-1] - self._arrivals[0]
        rate = (count - 1) / span if count > 1 and span > 0.0 else 0.0
        slow = 0.0 < rate < _SLOW * self._rate_hz
        text = f"SLOW, {self._rate_hz:g} Hz requested: " if slow else ""
        self.status = f"{where}: {text}{rate:.1f} Hz, {self._counts()}"

    def _counts(self) -> str:
        parts = [f"{self.sent} images"]
        parts += [f"{count} rejected ({reason})" for reason, count in self.rejected.most_common(3)]
        if self.dropped:
            parts.append(f"{self.dropped} dropped")
        if self.reconnects > 0:
            parts.append(f"reopened {self.reconnects} times")
        return ", ".join(parts)


class _CaptureThread:
    """Thread that reads a camera source and stores the newest frame.

    A separate thread is used because reading a failed camera may block for long.
    """

    def __init__(self, open_source: Callable[[], CameraSource]) -> None:
        self._open_source = open_source
        self._changed = threading.Condition()
        self._frame: CapturedFrame | None = None
        self._fault: CameraError | None = None
        self._stopped = False
        self._dropped = 0
        self.opened = False
        self.where = "camera"
        threading.Thread(target=self._run, name="camera", daemon=True).start()

    def take(self, timeout_s: float) -> CapturedFrame | None:
        """Return the newest frame that was not yet returned; None if no frame arrives within `timeout_s`.

        Raises:
            CameraError: the error that ended the source.
        """
        with self._changed:
            if self._frame is None and self._fault is None:
                self._changed.wait(timeout_s)
            frame, self._frame = self._frame, None
            if frame is None and self._fault is not None:
                raise self._fault
            return frame

    def take_dropped_count(self) -> int:
        """Return the number of frames that were replaced by newer ones since the last call."""
        with self._changed:
            count, self._dropped = self._dropped, 0
            return count

    def stop(self) -> None:
        """Request the thread to end after its present read, without waiting for it."""
        with self._changed:
            self._stopped = True

    def _run(self) -> None:
        source = None
        try:
            source = self._open_source()
            self.where, self.opened = source.where, True
            while not self._stopped:
                frame = source.read()
                with self._changed:
                    self._dropped += self._frame is not None
                    self._frame = frame
                    self._changed.notify()
        except CameraError as error:
            with self._changed:
                self._fault = error
                self._changed.notify()
        finally:
            if source is not None:
                source.close()
