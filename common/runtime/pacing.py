"""When a source's next message is due, and where a restarted source goes on."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from beamsplat.common.files.persist import ReplayPosition
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.node import SourceItem

log = logging.getLogger(__name__)


def wait_for_nodes(
    alive: Callable[[], set[str]],
    settings: LiveSettings,
    stopping: Callable[[], bool],
    say: Callable[[list[str]], None],
) -> None:
    """Returns when all that a source waits for are alive, after `wait_s` without them, or to stop."""
    deadline = time.monotonic() + settings.wait_s
    missing = settings.wait_for
    while missing and not stopping():
        missing = settings.wait_for - alive()
        if missing and time.monotonic() > deadline:
            log.warning("starting without %s: not active after %g s", ", ".join(sorted(missing)),
                        settings.wait_s)  # fmt: skip
            return
        if missing:
            say(sorted(missing))
            time.sleep(0.1)


class Playback:
    """Maps a recording's clock to this machine's, and keeps the place in the recording."""

    def __init__(self, rate: float, bookmark: ReplayPosition, resume: bool) -> None:
        """`rate` in times real time, 0 = as fast as possible; `resume` goes on at the bookmark."""
        self._rate = rate
        self._bookmark = bookmark
        self._first: tuple[int, float] | None = None
        self._resume_ns = bookmark.read() if resume else None

    def is_past(self, item: SourceItem) -> bool:
        """Whether a predecessor has sent this already."""
        return self._resume_ns is not None and item.at_ns is not None and item.at_ns <= self._resume_ns

    def wait_s(self, item: SourceItem) -> float:
        """Seconds until an item is due; not positive when it is."""
        if item.at_ns is None or self._rate == 0.0 or self.is_past(item):
            return 0.0
        now = time.monotonic()
        if self._first is None:
            self._first = (item.at_ns, now)
        first_ns, started = self._first
        return started + (item.at_ns - first_ns) / 1e9 / self._rate - now

    def sent(self, item: SourceItem) -> None:
        """Keeps the place behind a message that was sent."""
        if item.at_ns is not None and not self.is_past(item):
            self._bookmark.write(item.at_ns)


class TokenBucket:
    """So many a second, and twice as many at once after a pause: a token bucket of one thread."""

    def __init__(self, rate_hz: float, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._rate_hz, self._clock_s = rate_hz, clock_s
        self._left, self._at_s = 2.0 * rate_hz, clock_s()

    def take(self) -> bool:
        """Whether one more is allowed now."""
        now = self._clock_s()
        self._left = min(self._left + (now - self._at_s) * self._rate_hz, 2.0 * self._rate_hz)
        self._at_s = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True
