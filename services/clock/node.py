"""The clock node: one tick per second on the sensors' clock.

Nodes do their periodic background work on ticks. In a replay the ticks come from the recording's time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

from beamsplat.common.messages import Tick
from beamsplat.common.runtime.clock import StampClock
from beamsplat.common.runtime.node import Node, SourceItem

TICK_NS = 1_000_000_000  # nominal rate of the topic `tick`: 1 Hz


class ClockNode(Node):
    """Publishes `tick` at full seconds."""

    name = "clock"
    outputs = ("tick",)

    def configure(self) -> None:
        """Open the clock; the first tick is at the next full second."""
        self._clock = StampClock()

    def source(self) -> Iterator[SourceItem | None]:
        """Yield ticks without end; None in between.

        Seconds missed by a delay are left out, not published late.
        """
        count = 0
        due_ns = (self._clock.now_ns() // TICK_NS + 1) * TICK_NS
        while True:
            wait_ns = due_ns - self._clock.now_ns()
            if wait_ns > 0:
                time.sleep(min(wait_ns * 1e-9, 0.2))
                yield None
                continue
            yield SourceItem(None, "tick", Tick(stamp_ns=due_ns, count=count))
            count += 1
            due_ns = max(due_ns, self._clock.now_ns() // TICK_NS * TICK_NS) + TICK_NS
