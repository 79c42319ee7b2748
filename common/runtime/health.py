"""What the nodes of a robot last said of themselves, and the rates between what they said."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from beamsplat.common.messages import Health
from beamsplat.common.topics import TOPICS

STALE_S = 3.0  # a node silent for so long is not well
_WINDOW_S = 5.0
_HISTORY = 50  # within it, however often somebody speaks
_NODES = 1000  # of all robots: more are made up


@dataclass
class NodeRecord:
    """What was last heard of a node; `heard` is the listener's monotonic clock, s."""

    health: Health
    received_s: float
    starts: int = 1  # instances seen so far: one more after each restart
    history: deque[tuple[float, Health]] = field(default_factory=lambda: deque(maxlen=_HISTORY))

    def silent_s(self, now: float) -> float | None:
        """For how long nothing was heard; None while that is no longer than it may be."""
        return now - self.received_s if now - self.received_s > STALE_S else None

    def rate(self, count: Callable[[Health], int]) -> float:
        """Change of a counter per second over the last seconds."""
        (first, before), (last, after) = self.history[0], self.history[-1]
        if last - first < 0.5:
            return 0.0
        return (count(after) - count(before)) / (last - first)

    def totals(self) -> NodeTraffic:
        """Sums over the inputs, and rates over inputs and outputs."""
        inputs = self.health.inputs
        return NodeTraffic(
            in_hz=self.rate(lambda h: sum(i.received for i in h.inputs)),
            out_hz=self.rate(lambda h: sum(o.sent for o in h.outputs)),
            age_ms=max((i.age_ms for i in inputs), default=0.0),
            dropped=sum(i.dropped for i in inputs),
            lost=sum(i.lost for i in inputs),
            bad=sum(i.undecodable + i.stale for i in inputs),
        )


class NodeTraffic(NamedTuple):
    """One node's traffic; counts are since it started."""

    in_hz: float
    out_hz: float
    age_ms: float  # of the newest message of the input that lags most
    dropped: int
    lost: int
    bad: int


class TopicConsumer(NamedTuple):
    """One subscription of a topic."""

    node: str
    age_ms: float
    dropped: int
    lost: int


class TopicTraffic(NamedTuple):
    """One topic that flows."""

    topic: str
    producer: str
    hz: float
    nominal_hz: float  # 0 = on events
    bytes_s: float
    sent: int
    consumers: tuple[TopicConsumer, ...]


class HealthRecords:
    """The newest health of every node. Not locked: whoever shares it between threads does that."""

    def __init__(self) -> None:
        self.records: dict[str, NodeRecord] = {}

    def add(self, health: Health, now: float | None = None) -> None:
        """Enters what a node says, heard at `now` (monotonic, s)."""
        now = time.monotonic() if now is None else now
        if health.node not in self.records and len(self.records) >= _NODES:
            return
        record = self.records.setdefault(health.node, NodeRecord(health, now))
        if record.health.instance != health.instance:
            record.history.clear()
            record.starts += 1
        record.health, record.received_s = health, now
        record.history.append((now, health))
        while now - record.history[0][0] > _WINDOW_S:
            record.history.popleft()

    def states(self, now: float | None = None) -> dict[str, str]:
        """Node -> state, "silent" where nothing was heard lately."""
        now = time.monotonic() if now is None else now
        return {n: "silent" if r.silent_s(now) else r.health.state for n, r in self.records.items()}

    def traffic(self) -> list[TopicTraffic]:
        """The topics that somebody writes, in table order."""
        return [flow for name in TOPICS if (flow := self._flow(name)) is not None]

    def _flow(self, topic: str) -> TopicTraffic | None:
        for producer, record in self.records.items():
            sent = next((o.sent for o in record.health.outputs if o.topic == topic), None)
            if sent is None:
                continue
            consumers = tuple(
                TopicConsumer(name, entry.age_ms, entry.dropped, entry.lost)
                for name, other in self.records.items()
                for entry in other.health.inputs
                if entry.topic == topic
            )
            hz = record.rate(lambda h: _sent(h, topic)[0])
            bytes_s = record.rate(lambda h: _sent(h, topic)[1])
            return TopicTraffic(topic, producer, hz, TOPICS[topic].rate_hz, bytes_s, sent, consumers)
        return None


def _sent(health: Health, topic: str) -> tuple[int, int]:
    return next(((o.sent, o.bytes) for o in health.outputs if o.topic == topic), (0, 0))
