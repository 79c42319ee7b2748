"""Rate limit for repeated log messages: suppressed ones are counted."""

from __future__ import annotations

import time

_PERIOD_S = 5.0  # shortest time between two messages of one subject
_MAX_SUBJECTS = 256  # beyond that, the oldest is forgotten: a subject can contain text from outside


class RateLimitedLog:
    """Decides per subject whether a message is logged now. Not thread-safe."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, int]] = {}

    def due(self, subject: str) -> int | None:
        """Return None if a message on `subject` must not be logged now: the last one was too recent.

        Otherwise return the number of messages on `subject` suppressed since the last logged one.
        """
        now = time.monotonic()
        if subject not in self._last and len(self._last) >= _MAX_SUBJECTS:
            del self._last[next(iter(self._last))]
        last, count = self._last.get(subject, (now - _PERIOD_S, 0))
        if now - last < _PERIOD_S:
            self._last[subject] = (last, count + 1)
            return None
        self._last[subject] = (now, 0)
        return count
