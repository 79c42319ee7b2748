"""RateLimitedLog at a bounded rate: what repeats is counted and said once in a while."""

from __future__ import annotations

import time

_PERIOD_S = 5.0


class RateLimitedLog:
    """One clock and one count a subject."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, int]] = {}

    def due(self, subject: str) -> int | None:
        """How many were kept back since the last, if it is time for another; None: keep this one back."""
        now = time.monotonic()
        last, count = self._last.get(subject, (now - _PERIOD_S, 0))
        if now - last < _PERIOD_S:
            self._last[subject] = (last, count + 1)
            return None
        self._last[subject] = (now, 0)
        return count
