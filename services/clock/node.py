"""The clock node: publishes one tick per second on the clock of the sensors.

Nodes do their periodic background work on ticks. In a replay, the replay node publishes the ticks, on the
time of the recording.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

from beamsplat.common.messages import Tick
from beamsplat.common.runtime.clock import StampClock
from beamsplat.common.runtime.node import Node, SourceItem

TICK_NS = 1_000_000_000  # nominal rate of the topic `tick`: 1 Hz


class ClockNode(Node):
    """Publishes `tick` at each full second."""

    name = "clock"
    outputs = ("tick",)

    def configure(self) -> None:
        """Open the clock; the first tick is at the next full second."""
        self._clock = StampClock()

    def source(self) -> Iterator[SourceItem | None]:
        """Yield ticks without end; None between ticks.

        Ticks that are missed because of a delay are omitted, not published late.
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
