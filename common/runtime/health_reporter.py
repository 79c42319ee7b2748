"""Publishing of a live node's health once a second."""

from __future__ import annotations

import contextlib
import itertools
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import zenoh

from beamsplat.common.messages import Health, OutputHealth
from beamsplat.common.messages.header import local_clock_id
from beamsplat.common.redaction import without_secrets
from beamsplat.common.runtime.heap import trim_heap
from beamsplat.common.runtime.running_node import RunningNode
from beamsplat.common.zenoh.bus import Bus

_DETAIL_CHARS = 2000
_TRIM_EVERY = 30  # reports between two returns of freed memory


class HealthReporter:
    """Thread that publishes the node's health until the node is closed."""

    def __init__(self, running: RunningNode, bus: Bus) -> None:
        self._running, self._bus = running, bus
        self._clock_id = local_clock_id()
        self._process = psutil.Process()
        self._process.cpu_percent()  # the first call only starts the measurement
        threading.Thread(target=self._report, name="health", daemon=True).start()

    def _report(self) -> None:
        for count in itertools.count(1):
            if self._running.state == "closed":
                return
            try:
                self.send()
            except zenoh.ZError:  # the session is closing
                return
            if count % _TRIM_EVERY == 0:
                trim_heap()
            time.sleep(1.0)

    def send(self) -> None:
        """Publish one health report now, unless this process is in standby or retired."""
        r = self._running
        if r.handover.standby or r.handover.retired:  # another process is the active node
            return
        with r.changed:
            inputs = r.mailbox.health()
        self._measure_disk()
        steps, share = np.array(r.steps_ms or [0.0]), 1.0 / r.settings.nodes_in_process
        outputs = tuple(
            OutputHealth(topic=name, sent=p.sent, bytes=p.bytes, refused=p.refused)
            for name, p in r.publications.items()
        )
        self._bus.publish_health(
            Health(
                stamp_ns=time.time_ns(), node=r.node.name, instance=r.settings.instance,
                epoch=r.settings.epoch, state=r.state, inputs=inputs, outputs=outputs,
                step_p50_ms=float(np.percentile(steps, 50)), step_p95_ms=float(np.percentile(steps, 95)),
                rss_mb=share * self._process.memory_info().rss / 1e6,
                cpu_percent=share * self._process.cpu_percent(),
                detail=without_secrets(r.detail_text())[:_DETAIL_CHARS], pid=self._process.pid,
                rejected=r.node.rejections.report(), status=without_secrets(r.node.figures.status),
                figures=r.node.figures.report(), clock_id=self._clock_id,
            )
        )  # fmt: skip

    def _measure_disk(self) -> None:
        """Update the figures of the disk that the node writes to."""
        node = self._running.node
        folder = _existing(node.writes_to or self._running.settings.run_dir)
        with contextlib.suppress(OSError):  # a broken disk: the last figures remain
            usage = shutil.disk_usage(folder)
            node.figures.set("disk_free_bytes", usage.free)
            node.figures.set("disk_size_bytes", usage.total)


def _existing(path: Path) -> Path:
    """Return `path`, or its nearest parent that exists."""
    absolute = path.expanduser().absolute()
    return next((p for p in (absolute, *absolute.parents) if p.exists()), Path("/"))
