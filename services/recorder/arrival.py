"""Arrival times of messages for a recording, from the wall clock or from the stamps of replayed data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

_NOW_S = 300.0  # a first stamp within this time of now is from a running robot


class ArrivalClock:
    """Clock of arrival times (ns); for replayed data, arrival times never decrease.

    On a running robot, the arrival time is the time of publication on the wall clock of this host, so that
    the waiting time in a queue is not included. For replayed data, it is the newest stamp so far.
    """

    def __init__(
        self,
        kind: Literal["auto", "wall", "data"],
        wall_ns: Callable[[], int],
        monotonic_ns: Callable[[], int],
    ) -> None:
        self._wall: bool | None = None if kind == "auto" else kind == "wall"
        self._wall_ns = wall_ns
        self._monotonic_ns = monotonic_ns
        self._newest_ns = 0

    def arrival_ns(self, stamp_ns: int, published_ns: int | None) -> int:
        """Return the arrival time (ns) of a message.

        `published_ns`: reading of this host's `time.monotonic_ns` at publication; None if another host
        published the message.
        """
        if self._wall is None:
            self._wall = abs(self._wall_ns() - stamp_ns) < _NOW_S * 1e9
        if self._wall:
            waited_ns = 0 if published_ns is None else max(0, self._monotonic_ns() - published_ns)
            return self._wall_ns() - waited_ns
        self._newest_ns = max(self._newest_ns, stamp_ns)
        return self._newest_ns

    def now_ns(self) -> int | None:
        """Return the present time (ns), for messages without stamp; None before the first data message."""
        if self._wall:
            return self._wall_ns()
        return self._newest_ns or None
