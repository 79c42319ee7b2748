"""Delivery of events to a webhook: JSON by HTTP POST, from a thread of its own.

The caller never waits: events are queued, at most `MAX_QUEUED`, and beyond that the oldest is dropped. They
are sent in order, each until the receiver answers 2xx. While it cannot be reached, or answers 408, 429 or
5xx, the event is sent again after `BACK_OFF_S`; any other answer refuses the event, which is dropped.
Redirects are not followed: they would hand the token to another host.
"""

from __future__ import annotations

import http.client
import json
import logging
import threading
import urllib.error
import urllib.request
from collections import deque
from typing import Any

from beamsplat.common.runtime.rate_limited_log import RateLimitedLog

log = logging.getLogger(__name__)

MAX_QUEUED = 256
BACK_OFF_S = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0)  # before the next attempt; the last one again and again
_TIMEOUT_S = 10.0  # of one attempt
_AGAIN = (408, 429)  # besides 5xx: the receiver asks for another attempt
_CLOSE_S = 1.0  # for the attempt in progress when the node ends


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


class Webhook:
    """Sender of events to one address; call `close` at the end. `post` may be called from any thread."""

    def __init__(
        self, address: str, token: str = "", back_off_s: tuple[float, ...] = BACK_OFF_S,
        timeout_s: float = _TIMEOUT_S,
    ) -> None:  # fmt: skip
        self._address, self._back_off_s, self._timeout_s = address, back_off_s, timeout_s
        self._headers = {"Content-Type": "application/json", "User-Agent": "beamsplat"}
        if token:
            self._headers["Authorization"] = f"Bearer {token}"
        self._opener = urllib.request.build_opener(_NoRedirects)
        self._queue: deque[bytes] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._log_limit = RateLimitedLog()
        self.sent = self.refused = self.dropped = self.failed_attempts = 0
        self._thread = threading.Thread(target=self._run, name="webhook", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        """Return the number of events that wait, with the one that is being sent."""
        return len(self._queue)

    def post(self, event: dict[str, Any]) -> None:
        """Queue an event; return at once."""
        body = json.dumps(event, allow_nan=False).encode()
        with self._changed:
            if len(self._queue) >= MAX_QUEUED:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(body)
            self._changed.notify()

    def close(self) -> None:
        """End the thread; events that wait are discarded."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        attempts = 0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or bool(self._queue))
                if self._closed:
                    return
                body = self._queue[0]
            fault = self._send(body)
            if fault is None:
                attempts = 0
                with self._changed:
                    if self._queue and self._queue[0] is body:  # else it was dropped meanwhile
                        self._queue.popleft()
                continue
            pause_s = self._back_off_s[min(attempts, len(self._back_off_s) - 1)]
            attempts, self.failed_attempts = attempts + 1, self.failed_attempts + 1
            self._warn(f"was not reached ({fault}): tried again in {pause_s:g} s")
            with self._changed:
                if self._changed.wait_for(lambda: self._closed, pause_s):
                    return

    def _send(self, body: bytes) -> str | None:
        """Send one event; return None if it is done with, else why it must be sent again."""
        request = urllib.request.Request(self._address, body, self._headers, method="POST")
        try:
            with self._opener.open(request, timeout=self._timeout_s):
                self.sent += 1
                return None
        except urllib.error.HTTPError as error:
            error.close()
            if error.code >= 500 or error.code in _AGAIN:
                return f"status {error.code}"
            self.refused += 1
            self._warn(f"refused an alert with status {error.code}: check `webhook` and `webhook_token`")
            return None
        # The address and the token are not part of these texts.
        except urllib.error.URLError as error:
            return _short(error.reason)
        except (OSError, http.client.HTTPException) as error:
            return _short(error)

    def _warn(self, text: str) -> None:
        if (more := self._log_limit.due(text.partition(" ")[0])) is not None:
            log.warning("the webhook of alerts %s (%d more like this)", text, more)


def _short(error: object) -> str:
    if isinstance(error, OSError):
        return error.strerror or type(error).__name__
    return type(error).__name__ if isinstance(error, Exception) else str(error)
