"""Source of JPEG images over HTTP (multipart/x-mixed-replace); the bytes are returned unchanged."""

from __future__ import annotations

import contextlib
import http.client
from collections.abc import Callable
from urllib.parse import urlsplit

from beamsplat.services.camera.frame import CameraError, CapturedFrame

_MAX_BYTES = 16 * 1024 * 1024  # of one part; bounds the memory
_MAX_LINE = 4096  # bytes of one header line


def is_multipart(url: str, timeout_s: float) -> bool:
    """Return whether the server at `url` answers with a multipart stream.

    Raises:
        CameraError: the server does not answer.
    """
    source = HttpSource(url, timeout_s, lambda: 0, probe_only=True)
    source.close()
    return source.multipart


class HttpSource:
    """A multipart HTTP response in which each part is a JPEG. Parts without Content-Length are rejected."""

    def __init__(
        self, url: str, timeout_s: float, now_ns: Callable[[], int], *, probe_only: bool = False
    ) -> None:
        """Connect and send the request.

        Args:
            url: http or https address; user and password in the address are sent as basic authentication.
            timeout_s: for the connection and for each read.
            now_ns: returns the present time on the clock of the stamps, ns.
            probe_only: accept any answer, to find out only whether it is multipart (`multipart`).

        Raises:
            CameraError: no answer, or not a multipart stream (unless `probe_only`).
        """
        parts = urlsplit(url)
        kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        self._now_ns = now_ns
        self._connection = kind(parts.hostname or "", parts.port, timeout=timeout_s)
        self.where = f"{parts.scheme}://{parts.hostname}"  # without user and password
        path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        try:
            self._connection.request("GET", path, headers=_authorization(parts.username, parts.password))
            self._response = self._connection.getresponse()
        except (OSError, http.client.HTTPException) as error:
            self.close()
            raise CameraError(f"{self.where} does not answer: {error}") from error
        self.multipart = (self._response.headers.get_content_maintype()) == "multipart"
        if probe_only:
            return
        if self._response.status != 200 or not self.multipart:
            self.close()
            raise CameraError(
                f"{self.where} answers {self._response.status} {self._response.headers.get_content_type()}, "
                "not with a stream of images"
            )

    def read(self) -> CapturedFrame:
        """Return the next part; its stamp is the time at which its first header line arrived.

        Raises:
            CameraError: the stream ended, or no data arrived within the timeout.
        """
        try:
            length, stamp_ns = self._read_part_header()
            data = self._response.read(length)
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise CameraError(f"{self.where} stopped: {error}") from error
        if len(data) < length:
            raise CameraError(f"{self.where} closed the connection")
        return CapturedFrame(stamp_ns, data, None)

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(OSError):
            self._connection.close()

    def _read_part_header(self) -> tuple[int, int]:
        """Return the length of the next part (bytes) and the arrival time of its header (ns)."""
        length, stamp_ns, headed = -1, 0, False
        while True:
            line = self._response.readline(_MAX_LINE)
            if not line:
                raise CameraError(f"{self.where} closed the connection")
            if not headed and not line.strip():  # line break at the end of the previous part
                continue
            if not headed:
                headed, stamp_ns = True, self._now_ns()
            name, _, value = line.decode("latin-1").partition(":")
            if name.strip().lower() == "content-length":
                length = int(value)
            if not line.strip():
                if not 0 < length <= _MAX_BYTES:
                    raise CameraError(
                        f"{self.where} sends parts without Content-Length: use a source that OpenCV reads"
                    )
                return length, stamp_ns


def _authorization(user: str | None, password: str | None) -> dict[str, str]:
    if user is None:
        return {}
    import base64

    text = base64.b64encode(f"{user}:{password or ''}".encode()).decode()
    return {"Authorization": f"Basic {text}"}
