"""How a live node is doing, once a second on the bus."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

import numpy as np
import psutil
import zenoh

from beamsplat.common.messages import Health, OutputHealth
from beamsplat.common.zenoh.bus import Bus

if TYPE_CHECKING:
    from beamsplat.common.runtime.live import Live

_DETAIL_CHARS = 2000


class Vitals:
    """Reports from a thread of its own until the node is closed."""

    def __init__(self, live: Live, bus: Bus) -> None:
        self._live, self._bus = live, bus
        self._process = psutil.Process()
        self._process.cpu_percent()  # the first call only starts the measurement
        threading.Thread(target=self._report, name="health", daemon=True).start()

    def _report(self) -> None:
        while self._live.state != "closed":
            try:
                self.send()
            except zenoh.ZError:  # the session is closing
                return
            time.sleep(1.0)

    def send(self) -> None:
        """One report now; none before a takeover, or after one."""
        live = self._live
        if live.takeover.standby or live.takeover.retired:  # another one is the node
            return
        with live.changed:
            inputs = live.mailbox.health()
        steps = np.array(live.steps_ms or [0.0])
        outputs = tuple(
            OutputHealth(topic=name, sent=p.sent, bytes=p.bytes) for name, p in live.publications.items()
        )
        self._bus.report(
            Health(
                stamp_ns=time.time_ns(), node=live.node.name, instance=live.instance, epoch=self._bus.epoch,
                state=live.state, inputs=inputs, outputs=outputs,
                step_p50_ms=float(np.percentile(steps, 50)), step_p95_ms=float(np.percentile(steps, 95)),
                rss_mb=self._process.memory_info().rss / 1e6, cpu_percent=self._process.cpu_percent(),
                detail=(live.detail or live.node.detail)[:_DETAIL_CHARS],
            )
        )  # fmt: skip
