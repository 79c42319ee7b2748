"""When a message arrived, on the clock that its recording should have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

_NOW_S = 300.0  # a first stamp nearer to now than this comes from a running robot


class ArrivalClock:
    """Arrival times in nanoseconds, never running backwards on the data's clock.

    On a running robot arrival is the time of publication by this host's clock: what lay in a queue since
    did not arrive later for that. Replayed data have a clock of their own, which only their stamps tell.
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
        """Arrival of a message; `published_ns` is its publication on this host's monotonic clock, None
        where another host published it."""
        if self._wall is None:
            self._wall = abs(self._wall_ns() - stamp_ns) < _NOW_S * 1e9
        if self._wall:
            waited_ns = 0 if published_ns is None else max(0, self._monotonic_ns() - published_ns)
            return self._wall_ns() - waited_ns
        self._newest_ns = max(self._newest_ns, stamp_ns)
        return self._newest_ns

    def now_ns(self) -> int | None:
        """Now, for what has no stamp of the data's clock; None before the first message of the data."""
        if self._wall:
            return self._wall_ns()
        return self._newest_ns or None
