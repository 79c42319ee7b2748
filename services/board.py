"""The health of all nodes of a robot, collected from the bus and drawn as a table."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, field

import zenoh
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from common.bus import key
from common.header import DecodeError
from common.messages import Health
from common.streams import open_sample
from common.topics import HEALTH, TOPICS, Topic

STALE_S = 3.0  # a node silent for so long is not well
_WINDOW_S = 5.0


@dataclass
class NodeRecord:
    """What was last heard of a node."""

    health: Health
    heard: float
    history: deque[tuple[float, Health]] = field(default_factory=deque)


class HealthBoard:
    """Listens to health/* in a thread of its own until the session is closed."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self.records: dict[str, NodeRecord] = {}
        self._lock = threading.Lock()
        self._row = Topic(HEALTH, Health, (), 1, "latest")
        self._subscriber = session.declare_subscriber(
            key(robot, HEALTH, "*"), zenoh.handlers.FifoChannel(256)
        )
        threading.Thread(target=self._receive, name="health-board", daemon=True).start()

    def _receive(self) -> None:
        while True:
            try:
                sample = self._subscriber.recv()
            except zenoh.ZError:
                return
            try:
                health = open_sample(sample, self._row).message
            except DecodeError:  # another version's health cannot be shown; its node still runs
                continue
            now = time.monotonic()
            with self._lock:
                record = self.records.setdefault(health.node, NodeRecord(health, now))
                if record.health.instance != health.instance:
                    record.history.clear()
                record.health, record.heard = health, now
                record.history.append((now, health))
                while now - record.history[0][0] > _WINDOW_S:
                    record.history.popleft()

    def states(self) -> dict[str, str]:
        """Node -> state, "silent" where nothing was heard lately."""
        now = time.monotonic()
        with self._lock:
            return {
                name: r.health.state if now - r.heard < STALE_S else "silent"
                for name, r in self.records.items()
            }

    def nodes_table(self) -> RenderableType:
        """One row a node: state, rates, step time, age, losses, memory, CPU; below, what they say."""
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
        for heading in ("node", "state"):
            table.add_column(heading, no_wrap=True)
        for heading in ("in Hz", "out Hz", "step ms", "p95", "age ms", "drop", "lost", "bad", "MB", "CPU%"):
            table.add_column(heading, justify="right", no_wrap=True)
        now = time.monotonic()
        said = []
        with self._lock:
            for name, record in sorted(self.records.items()):
                table.add_row(*_node_row(name, record, now))
                if record.health.detail:
                    said.append(Text(f"{name}: {record.health.detail}", style="dim"))
        return Group(table, *said)

    def topics_table(self) -> Table:
        """One row a topic that flows: producer, rate, bytes, and who takes it."""
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
        for heading in ("topic", "from"):
            table.add_column(heading)
        for heading in ("Hz", "nominal", "KB/s", "sent"):
            table.add_column(heading, justify="right")
        table.add_column("to (age ms, dropped, lost)")
        with self._lock:
            for name in TOPICS:
                row = _topic_row(name, self.records)
                if row:
                    table.add_row(*row)
        return table


def _node_row(name: str, record: NodeRecord, now: float) -> tuple[str, ...]:
    health = record.health
    silent = now - record.heard > STALE_S
    colour = "red" if silent else {"active": "green", "drained": "cyan"}.get(health.state, "yellow")
    state = f"silent {now - record.heard:.0f} s" if silent else health.state
    return (
        name,
        f"[{colour}]{state}[/]",
        f"{_rate(record, lambda h: sum(i.received for i in h.inputs)):.1f}" if health.inputs else "",
        f"{_rate(record, lambda h: sum(o.sent for o in h.outputs)):.1f}" if health.outputs else "",
        f"{health.step_p50_ms:.1f}",
        f"{health.step_p95_ms:.1f}",
        f"{max((i.age_ms for i in health.inputs), default=0.0):.1f}" if health.inputs else "",
        _count(sum(i.dropped for i in health.inputs), "yellow"),
        _count(sum(i.lost for i in health.inputs), "red"),
        _count(sum(i.undecodable + i.stale for i in health.inputs), "red"),
        f"{health.rss_mb:.0f}",
        f"{health.cpu_percent:.0f}",
    )


def _topic_row(topic: str, records: dict[str, NodeRecord]) -> tuple[str, ...] | None:
    for producer, record in records.items():
        sent = next((o for o in record.health.outputs if o.topic == topic), None)
        if sent is None:
            continue
        takers = []
        for name, other in records.items():
            for entry in other.health.inputs:
                if entry.topic == topic:
                    takers.append(f"{name} ({entry.age_ms:.1f}, {entry.dropped}, {entry.lost})")
        hz = _rate(record, lambda h: _sent(h, topic)[0])
        kb = _rate(record, lambda h: _sent(h, topic)[1]) / 1e3
        nominal = f"{TOPICS[topic].rate_hz:g}" if TOPICS[topic].rate_hz else "event"
        return topic, producer, f"{hz:.1f}", nominal, f"{kb:.1f}", str(sent.sent), "  ".join(takers)
    return None


def _sent(health: Health, topic: str) -> tuple[int, int]:
    return next(((o.sent, o.bytes) for o in health.outputs if o.topic == topic), (0, 0))


def _rate(record: NodeRecord, count: object) -> float:
    """Change of a counter per second over the last seconds."""
    (first, before), (last, after) = record.history[0], record.history[-1]
    if last - first < 0.5:
        return 0.0
    return (count(after) - count(before)) / (last - first)


def _count(number: int, colour: str) -> str:
    return f"[{colour}]{number}[/]" if number else "0"
