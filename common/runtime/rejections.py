"""Counts of what a node has refused, by reason, for its health and for the summary of a run."""

from __future__ import annotations

import threading
from collections import Counter

from beamsplat.common.messages import Message, Rejected
from beamsplat.common.status import general_reason

MOST_REASONS = 48  # per node; further ones are counted together
MOST_REPORTED = 64  # limit of the field `rejected` of Health
OTHER = "other reasons"
_CHARS = 160
# Topics whose messages have a status: anything but "ok" says that this result is missing.
WITH_STATUS = frozenset({"localization/odometry", "depth/estimate", "fusion/depth", "mapping/status"})


class Rejections:
    """Bounded counter of reasons; every method may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[tuple[str, str]] = Counter()

    def add(self, reason: str, topic: str = "") -> None:
        """Count one refused input or result.

        Args:
            reason: numbers in it are replaced by N, so that equal reasons are counted together.
            topic: of the result that is missing; "" if this was an input.
        """
        entry = (topic, general_reason(reason)[:_CHARS])
        with self._lock:
            if entry not in self._counts and len(self._counts) >= MOST_REASONS:
                entry = (topic, OTHER)
            self._counts[entry] += 1

    def set(self, reason: str, count: int) -> None:
        """Set the number of inputs that were refused for a reason, counted elsewhere.

        The caller bounds the number of reasons; beyond `MOST_REPORTED` in all, further ones are ignored.
        """
        entry = ("", reason[:_CHARS])
        with self._lock:
            if count and (entry in self._counts or len(self._counts) < MOST_REPORTED):
                self._counts[entry] = count

    def add_status(self, topic: str, message: Message) -> None:
        """Count a published message whose status is not "ok"."""
        status = getattr(message, "status", "ok") if topic in WITH_STATUS else "ok"
        if status != "ok":
            detail = getattr(message, "detail", "")
            self.add(f"{status}: {detail}" if detail else status, topic)

    def report(self) -> tuple[Rejected, ...]:
        """Return the counts, for the field `rejected` of a Health message."""
        with self._lock:
            return tuple(
                Rejected(topic=topic, reason=reason, count=count)
                for (topic, reason), count in self._counts.items()
            )
