"""When a source's next message is due, and where a restarted source goes on."""

from __future__ import annotations

import time

from common.node import Sourced
from common.persist import Bookmark


class Playback:
    """Maps a recording's clock to this machine's, and keeps the place in the recording."""

    def __init__(self, rate: float, bookmark: Bookmark, resume: bool) -> None:
        """`rate` in times real time, 0 = as fast as possible; `resume` goes on at the bookmark."""
        self._rate = rate
        self._bookmark = bookmark
        self._first: tuple[int, float] | None = None
        self._resume_ns = bookmark.read() if resume else None

    def is_past(self, item: Sourced) -> bool:
        """Whether a predecessor has sent this already."""
        return self._resume_ns is not None and item.at_ns is not None and item.at_ns <= self._resume_ns

    def wait_s(self, item: Sourced) -> float:
        """Seconds until an item is due; not positive when it is."""
        if item.at_ns is None or self._rate == 0.0 or self.is_past(item):
            return 0.0
        now = time.monotonic()
        if self._first is None:
            self._first = (item.at_ns, now)
        first_ns, started = self._first
        return started + (item.at_ns - first_ns) / 1e9 / self._rate - now

    def sent(self, item: Sourced) -> None:
        """Keeps the place behind a message that was sent."""
        if item.at_ns is not None and not self.is_past(item):
            self._bookmark.write(item.at_ns)
