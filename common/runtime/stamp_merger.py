"""Merging streams by stamp, so that a node sees the same order live and replayed.

A message is released once every other stream has shown that nothing older will come: its newest
stamp is not before the message's, or it has ended. A stream that falls behind the newest stamp by
more than `patience_ns` stops being waited for until it speaks again. Without a clock all of this
depends on the data alone. With one (live), a stream must have been silent for as long by that clock
as well: one that is merely late on its way, on a busy machine or at many times real time, is waited
for, and the order stays that of the stamps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

PATIENCE_NS = 500_000_000
_END_NS = 2**63 - 1


class StampMerger:
    """In-order streams in, one stream ordered by (stamp, stream number) out."""

    def __init__(
        self,
        streams: tuple[str, ...],
        patience_ns: int = PATIENCE_NS,
        clock_ns: Callable[[], int] | None = None,
    ) -> None:
        self._queues: dict[str, deque[tuple[int, Any]]] = {name: deque() for name in streams}
        self._newest_ns: dict[str, int] = {}
        self._heard_ns: dict[str, int] = {}  # by the clock
        self._order = {name: i for i, name in enumerate(streams)}
        self._patience_ns = patience_ns
        self._clock_ns = clock_ns
        self._first_ns: int | None = None  # from when on a stream that never spoke is missed
        self._released_ns = 0
        self.late = 0  # released behind a younger one, because their stream had been given up

    def __len__(self) -> int:
        return sum(len(queue) for queue in self._queues.values())

    def queued(self, stream: str) -> int:
        """Items of `stream` not yet released."""
        return len(self._queues[stream])

    def items(self) -> Iterator[Any]:
        """What is not yet released, stream by stream."""
        return (item for queue in self._queues.values() for _, item in queue)

    def put(self, stream: str, stamp_ns: int, item: Any) -> None:
        """Takes one item; stamps may jump back within a stream, order of arrival is then kept."""
        now_ns = self._clock_ns() if self._clock_ns else 0
        if self._first_ns is None:
            self._first_ns = stamp_ns
            self._heard_ns = dict.fromkeys(self._queues, now_ns)  # silence is counted from here
        self._first_ns = min(self._first_ns, stamp_ns)
        self._queues[stream].append((stamp_ns, item))
        self._newest_ns[stream] = stamp_ns
        self._heard_ns[stream] = now_ns

    def drop_oldest(self, stream: str) -> Any:
        """Takes the oldest item out of `stream`: the caller's bound was hit, and the caller counts."""
        return self._queues[stream].popleft()[1]

    def end(self, stream: str) -> None:
        """Nothing more will come from `stream`, unless a successor speaks."""
        self._newest_ns[stream] = _END_NS

    def pop(self) -> tuple[str, Any] | None:
        """The next (stream, item), or None while it is not certain which that is."""
        heads = [(queue[0][0], self._order[name], name) for name, queue in self._queues.items() if queue]
        if not heads:
            return None
        stamp_ns, _, stream = min(heads)
        # What is here and was last heard, not the highest stamp ever: clocks are set back, and stamps err.
        newest_ns = (newest for newest in self._newest_ns.values() if newest != _END_NS)
        front_ns = max(max(newest_ns, default=0), max(heads)[0])
        for name, queue in self._queues.items():
            silent = not queue and self._newest_ns.get(name, -1) < stamp_ns
            if silent and not self._given_up(name, front_ns):
                return None
        self.late += stamp_ns < self._released_ns
        self._released_ns = stamp_ns
        return stream, self._queues[stream].popleft()[1]

    def _given_up(self, name: str, front_ns: int) -> bool:
        if front_ns - self._newest_ns.get(name, self._first_ns) <= self._patience_ns:
            return False
        if self._clock_ns is None:
            return True
        return self._clock_ns() - self._heard_ns[name] > self._patience_ns

    @property
    def ended(self) -> bool:
        """All streams have ended and are empty."""
        return not len(self) and all(self._newest_ns.get(name) == _END_NS for name in self._queues)
