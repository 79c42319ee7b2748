"""What has been sent and not been acknowledged: kept within a bound, sent again while nobody answers."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Generic, TypeVar

Item = TypeVar("Item")


@dataclass
class _Sent(Generic[Item]):
    item: Item
    last_ns: int


class Outbox(Generic[Item]):
    """Oldest first. Times are those of measurements, so that a replay repeats what was sent again."""

    def __init__(self, limit: int, retry_ns: int) -> None:
        if limit < 1 or retry_ns <= 0:
            raise ValueError(f"limit and retry_ns must be positive, got {limit} and {retry_ns}")
        self._limit, self._retry_ns = limit, retry_ns
        self._waiting: OrderedDict[int, _Sent[Item]] = OrderedDict()
        self.given_up = 0  # never acknowledged, and overtaken by newer ones

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, key: int, item: Item, now_ns: int) -> None:
        """Takes what is sent now; beyond the bound the oldest goes, and is counted."""
        self._waiting[key] = _Sent(item, now_ns)
        while len(self._waiting) > self._limit:
            self._waiting.popitem(last=False)
            self.given_up += 1

    def acknowledge(self, key: int) -> bool:
        """It has arrived. False if it was not waited for."""
        return self._waiting.pop(key, None) is not None

    def due(self, now_ns: int) -> Item | None:
        """What to send again. Only the oldest is tried: once it is answered, the next one is due at once."""
        if not self._waiting:
            return None
        oldest = next(iter(self._waiting.values()))
        if now_ns - oldest.last_ns < self._retry_ns:
            return None
        oldest.last_ns = now_ns
        return oldest.item
