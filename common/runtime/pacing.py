"""Pacing of recorded sources, the position where a restarted source continues, and a token bucket."""

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
    on_waiting: Callable[[list[str]], None],
) -> None:
    """Block until all nodes in `settings.wait_for` are active.

    Return earlier after `settings.wait_s` seconds, or when `stopping()` returns True.

    Args:
        alive: returns the names of the active nodes.
        on_waiting: called repeatedly with the names of the nodes that are not active yet.
    """
    deadline = time.monotonic() + settings.wait_s
    missing = settings.wait_for
    while missing and not stopping():
        missing = settings.wait_for - alive()
        if missing and time.monotonic() > deadline:
            log.warning("starting without %s: not active after %g s", ", ".join(sorted(missing)),
                        settings.wait_s)  # fmt: skip
            return
        if missing:
            on_waiting(sorted(missing))
            time.sleep(0.1)


class Playback:
    """Maps the clock of a recording to the host's clock, and stores the position in the recording."""

    def __init__(self, rate: float, position: ReplayPosition, resume: bool) -> None:
        """`rate`: speed as a multiple of real time, 0 = as fast as possible.

        `resume`: continue after the position stored by the process before the restart.
        """
        self._rate = rate
        self._position = position
        self._first: tuple[int, float] | None = None
        self._resume_ns = position.read() if resume else None

    def is_past(self, item: SourceItem) -> bool:
        """Return whether the process before the restart has already published this item."""
        return self._resume_ns is not None and item.at_ns is not None and item.at_ns <= self._resume_ns

    def wait_s(self, item: SourceItem) -> float:
        """Return the time in s until an item must be published; zero or negative if that time has come."""
        if item.at_ns is None or self._rate == 0.0 or self.is_past(item):
            return 0.0
        now = time.monotonic()
        if self._first is None:
            self._first = (item.at_ns, now)
        first_ns, started = self._first
        return started + (item.at_ns - first_ns) / 1e9 / self._rate - now

    def mark_published(self, item: SourceItem) -> None:
        """Store the arrival time of a published item on disk as the position in the recording."""
        if item.at_ns is not None and not self.is_past(item):
            self._position.write(item.at_ns)


class TokenBucket:
    """Token bucket: `rate_hz` tokens per second, capacity `2 * rate_hz`. Not thread-safe."""

    def __init__(self, rate_hz: float, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._rate_hz, self._clock_s = rate_hz, clock_s
        self._tokens, self._at_s = 2.0 * rate_hz, clock_s()

    def take(self) -> bool:
        """Take a token; return False if the bucket is empty."""
        now = self._clock_s()
        self._tokens = min(self._tokens + (now - self._at_s) * self._rate_hz, 2.0 * self._rate_hz)
        self._at_s = now
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True
