"""The newest health report of each node, and rates computed from recent reports."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from beamsplat.common.messages import Health
from beamsplat.common.topics import TOPICS

STALE_S = 3.0  # nodes report at 1 Hz: after three missing reports a node is shown as silent
_WINDOW_S = 5.0  # rates are averages over this time
_MAX_HISTORY = 50  # reports kept per node, in case it sends more than it should
_MAX_NODES = 1000  # of all robots; names beyond that are ignored, since anybody can send them


@dataclass
class NodeRecord:
    """Newest health report of a node, and its recent reports.

    `received_s` is the arrival time of the newest report: seconds of the receiver's `time.monotonic`.
    """

    health: Health
    received_s: float
    starts: int = 1  # number of instances (processes) seen so far
    history: deque[tuple[float, Health]] = field(default_factory=lambda: deque(maxlen=_MAX_HISTORY))

    def silent_s(self, now: float) -> float | None:
        """Return the time in s from the last report to `now`, or None if this time is at most `STALE_S`.

        `now` is a reading of `time.monotonic` in seconds.
        """
        return now - self.received_s if now - self.received_s > STALE_S else None

    def rate(self, count: Callable[[Health], int]) -> float:
        """Return the mean rate (1/s) of a counter between the oldest and the newest stored report.

        `count` reads the counter from a report. The rate is 0 while the reports span less than 0.5 s.
        """
        (first, before), (last, after) = self.history[0], self.history[-1]
        if last - first < 0.5:
            return 0.0
        return (count(after) - count(before)) / (last - first)

    def totals(self) -> NodeTraffic:
        """Return the message rates and counters of this node, summed over its inputs and outputs."""
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
    """Message rates of one node, and its counts of dropped, lost and bad messages since it started."""

    in_hz: float
    out_hz: float
    age_ms: float  # of the newest message on the input with the highest latency
    dropped: int
    lost: int
    bad: int


class TopicConsumer(NamedTuple):
    """Counters of one node's subscription to a topic; `age_ms` is the age of its newest message."""

    node: str
    age_ms: float
    dropped: int
    lost: int


class TopicTraffic(NamedTuple):
    """Message rate, byte rate (bytes per second) and count of one topic, and its subscriptions."""

    topic: str
    producer: str
    hz: float
    nominal_hz: float  # 0 = published on events
    bytes_s: float
    sent: int
    consumers: tuple[TopicConsumer, ...]


class HealthRecords:
    """The newest health report of every node. Not thread-safe: its owner must lock it."""

    def __init__(self) -> None:
        self.records: dict[str, NodeRecord] = {}

    def add(self, health: Health, now: float | None = None) -> None:
        """Store a health report that arrived at `now`, in seconds of `time.monotonic` (default: now)."""
        now = time.monotonic() if now is None else now
        if health.node not in self.records and len(self.records) >= _MAX_NODES:
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
        """Return the state of each node by node name; "silent" if its last report is older than `STALE_S`.

        `now` is in seconds of `time.monotonic` (default: now).
        """
        now = time.monotonic() if now is None else now
        return {n: "silent" if r.silent_s(now) else r.health.state for n, r in self.records.items()}

    def traffic(self) -> list[TopicTraffic]:
        """Return the traffic of all topics that have a producer, in the order of the topic table."""
        return [traffic for name in TOPICS if (traffic := self._traffic_of(name)) is not None]

    def _traffic_of(self, topic: str) -> TopicTraffic | None:
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
