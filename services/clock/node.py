"""A tick a second on the sensors' clock: for nodes that use idle time, on robots that replay nothing."""

from __future__ import annotations

import time
from collections.abc import Iterator

from beamsplat.common.messages import Tick
from beamsplat.common.runtime.clock import StampClock
from beamsplat.common.runtime.node import Node, Sourced

TICK_NS = 1_000_000_000


class ClockNode(Node):
    """See module."""

    name = "clock"
    outputs = ("tick",)

    def configure(self) -> None:
        """Makes ready; the first tick comes with the first full second."""
        self._clock = StampClock()

    def source(self) -> Iterator[Sourced | None]:
        """Ticks for ever; None while there is nothing to say. A late one is said once, not made up for."""
        count = 0
        due_ns = (self._clock.now_ns() // TICK_NS + 1) * TICK_NS
        while True:
            wait_ns = due_ns - self._clock.now_ns()
            if wait_ns > 0:
                time.sleep(min(wait_ns * 1e-9, 0.2))
                yield None
                continue
            yield Sourced(None, "tick", Tick(stamp_ns=due_ns, count=count))
            count += 1
            due_ns = max(due_ns, self._clock.now_ns() // TICK_NS * TICK_NS) + TICK_NS
