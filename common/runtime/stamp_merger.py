"""Merging of streams by stamp, so that a node receives messages in the same order live and in replay.

A message is released once no other stream can deliver an older one: each other stream has a newest stamp at
or after the message's stamp, or has ended. A stream whose newest stamp is more than `timeout_ns` behind the
newest stamp of all streams is not waited for, until its next message. Without a clock (lockstep) this depends
on the data alone. With a clock (live), the stream must also have been silent for `timeout_ns` of that clock:
messages that are only delayed, by a busy machine or by replay faster than real time, are waited for, and the
order stays the order of the stamps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

TIMEOUT_NS = 500_000_000  # longer than two periods of a 5 Hz lidar
_END_NS = 2**63 - 1


class StampMerger:
    """Merges in-order streams into one stream ordered by (stamp, position in `streams`)."""

    def __init__(
        self,
        streams: tuple[str, ...],
        timeout_ns: int = TIMEOUT_NS,
        clock_ns: Callable[[], int] | None = None,
    ) -> None:
        self._queues: dict[str, deque[tuple[int, Any]]] = {name: deque() for name in streams}
        self._newest_ns: dict[str, int] = {}
        self._arrival_ns: dict[str, int] = {}  # arrival time of the newest item by the clock
        self._order = {name: i for i, name in enumerate(streams)}
        self._timeout_ns = timeout_ns
        self._clock_ns = clock_ns
        self._first_ns: int | None = None  # stamp from which a stream without messages counts as behind
        self._released_ns = 0
        self.late = 0  # items released after a newer one, because their stream was not waited for

    def __len__(self) -> int:
        return sum(len(queue) for queue in self._queues.values())

    def queued(self, stream: str) -> int:
        """Return the number of queued items of `stream`."""
        return len(self._queues[stream])

    def items(self) -> Iterator[Any]:
        """Yield the queued items, stream by stream."""
        return (item for queue in self._queues.values() for _, item in queue)

    def put(
        self,
        stream: str,
        stamp_ns: int,
        item: Any,
        precedes: Callable[[Any, Any], bool] = lambda earlier, later: False,
    ) -> None:
        """Queue an item with its stamp (ns).

        Items of one stream stay in order of arrival, even if their stamps decrease. But an item for which
        `precedes(item, queued)` is True (a message that was recovered late) is queued before `queued`.
        """
        now_ns = self._clock_ns() if self._clock_ns else 0
        if self._first_ns is None:
            self._first_ns = stamp_ns
            self._arrival_ns = dict.fromkeys(
                self._queues, now_ns
            )  # start of the time-out for streams without messages
        self._first_ns = min(self._first_ns, stamp_ns)
        queue, position = self._queues[stream], len(self._queues[stream])
        while position and precedes(item, queue[position - 1][1]):
            position -= 1
        if position == len(queue):
            self._newest_ns[stream] = stamp_ns
        queue.insert(position, (stamp_ns, item))
        self._arrival_ns[stream] = now_ns

    def drop_oldest(self, stream: str) -> Any:
        """Remove and return the oldest queued item of `stream`; for callers that limit the queue's size."""
        return self._queues[stream].popleft()[1]

    def end(self, stream: str) -> None:
        """Mark `stream` as ended; a later item (of a restarted producer) reopens it."""
        self._newest_ns[stream] = _END_NS

    def pop(self) -> tuple[str, Any] | None:
        """Remove and return the next (stream, item), or None while an older item could still arrive."""
        heads = [(queue[0][0], self._order[name], name) for name, queue in self._queues.items() if queue]
        if not heads:
            return None
        stamp_ns, _, stream = min(heads)
        # Queued and last received stamps, not the highest ever: clocks are set back, and stamps can be wrong.
        newest_ns = (newest for newest in self._newest_ns.values() if newest != _END_NS)
        front_ns = max(max(newest_ns, default=0), max(heads)[0])
        for name, queue in self._queues.items():
            silent = not queue and self._newest_ns.get(name, -1) < stamp_ns
            if silent and not self._timed_out(name, front_ns):
                return None
        self.late += stamp_ns < self._released_ns
        self._released_ns = stamp_ns
        return stream, self._queues[stream].popleft()[1]

    def _timed_out(self, name: str, front_ns: int) -> bool:
        newest_ns = self._newest_ns.get(name, self._first_ns)
        assert newest_ns is not None  # set by the first `put`
        if front_ns - newest_ns <= self._timeout_ns:
            return False
        if self._clock_ns is None:
            return True
        return self._clock_ns() - self._arrival_ns[name] > self._timeout_ns

    @property
    def ended(self) -> bool:
        """Whether all streams have ended and all items are released."""
        return not len(self) and all(self._newest_ns.get(name) == _END_NS for name in self._queues)
