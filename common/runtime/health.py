"""The newest health report of each node, and rates computed from recent reports."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from beamsplat.common.messages import Health
from beamsplat.common.messages.instances import ProcessId
from beamsplat.common.runtime.accepted_producer import SILENCE_S, AcceptedProducer
from beamsplat.common.topics import TOPICS

STALE_S = 3.0  # nodes report at 1 Hz: after three missing reports a node is shown as silent
_WINDOW_S = 5.0  # rates are averages over this time
_MAX_HISTORY = 50  # reports kept per node, in case it sends more than it should
_MAX_RESTARTS = 16  # whose times are kept per node
_MAX_NODES = 1000  # of all robots; names beyond that are ignored, since anybody can send them
_FORGET_S = 60.0  # a silent node makes room for another one after this time


@dataclass
class NodeRecord:
    """Newest health report of a node, and its recent reports.

    `received_s` is the arrival time of the newest report: seconds of the receiver's `time.monotonic`.
    """

    health: Health
    received_s: float
    starts: int = 1  # number of instances (processes) seen so far
    earlier_losses: Counter[str] = field(default_factory=Counter)  # of processes before this one
    earlier_results: Counter[str] = field(default_factory=Counter)
    refused: int = 0  # reports of other processes, which are not accepted as this node
    history: deque[tuple[float, Health]] = field(default_factory=lambda: deque(maxlen=_MAX_HISTORY))
    restarts_s: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_RESTARTS))  # their times

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

    def figure(self, name: str) -> float | None:
        """Return a figure of the newest report (`runtime.figures`), None if the node does not report it."""
        return next((figure.value for figure in self.health.figures if figure.name == name), None)

    def losses(self) -> Counter[str]:
        """Return what all processes of this node have refused, dropped and lost: counts by reason."""
        return self.earlier_losses + losses_of(self.health)

    def results(self) -> dict[str, int]:
        """Return the number of usable results of all processes of this node by topic."""
        now = results_of(self.health)
        topics = dict.fromkeys((*self.earlier_results, *now))
        return {topic: self.earlier_results[topic] + now.get(topic, 0) for topic in topics}

    def totals(self) -> NodeTraffic:
        """Return the message rates and counters of this node, summed over its inputs and outputs."""
        inputs = self.health.inputs
        return NodeTraffic(
            in_hz=self.rate(lambda h: sum(i.received for i in h.inputs)),
            out_hz=self.rate(lambda h: sum(o.sent for o in h.outputs)),
            age_ms=max((i.age_ms for i in inputs), default=0.0),
            dropped=sum(i.dropped for i in inputs),
            lost=sum(i.lost for i in inputs),
            late=sum(i.late for i in inputs),
            bad=sum(i.undecodable + i.stale + i.refused for i in inputs),
        )


def losses_of(health: Health) -> Counter[str]:
    """Return what one process has refused, dropped and lost: counts by reason."""
    found: Counter[str] = Counter()
    for entry in health.inputs:
        found[f"{entry.topic}: dropped, a newer message was ready or the queue was full"] = entry.dropped
        found[f"{entry.topic}: lost"] = entry.lost
        found[f"{entry.topic}: not decodable"] = entry.undecodable
        found[f"{entry.topic}: repeated, or of an earlier process"] = entry.stale
        found[f"{entry.topic}: of another process than the publisher"] = entry.refused
    for sent in health.outputs:
        found[f"{sent.topic}: too large to be published"] = sent.refused
    for rejected in health.rejected:
        found[f"{rejected.topic}: {rejected.reason}" if rejected.topic else rejected.reason] += rejected.count
    return +found


def results_of(health: Health) -> dict[str, int]:
    """Return how many messages one process has published by topic, without those whose status is not "ok"."""
    refused = Counter[str]()
    for rejected in health.rejected:
        refused[rejected.topic] += rejected.count
    return {entry.topic: max(entry.sent - refused[entry.topic], 0) for entry in health.outputs}


class NodeTraffic(NamedTuple):
    """Message rates of one node, and its counts of dropped, lost, late and bad messages since it started."""

    in_hz: float
    out_hz: float
    age_ms: float  # of the newest message on the input with the highest latency
    dropped: int
    lost: int
    late: int
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


class HealthFilter:
    """Which process may report the health of each node (`AcceptedProducer`). Not thread-safe."""

    def __init__(self) -> None:
        self._producers: dict[str, AcceptedProducer] = {}
        self._heard_s: dict[str, float] = {}  # time of the last accepted report, by node
        self.refused: dict[str, int] = {}  # reports of other processes, by node
        self.ignored = 0  # reports beyond `_MAX_NODES` nodes

    def accepts(self, health: Health, now: float) -> bool:
        """Return whether a report that arrived at `now` (s) is of the accepted process; else count it."""
        node = health.node
        if node not in self._producers:
            if len(self._producers) >= _MAX_NODES and not self._forget_silent(now):
                self.ignored += 1
                return False
            self._producers[node], self.refused[node] = AcceptedProducer(), 0
        process = ProcessId(node.rpartition("/")[2], health.epoch, health.instance)
        silent = now - self._heard_s.get(node, now) > SILENCE_S
        if self._producers[node].judge(process, silent) in ("stale", "refused"):
            self.refused[node] += 1
            return False
        self._heard_s[node] = now
        return True

    @property
    def total_refused(self) -> int:
        """Number of reports that were not accepted, of all nodes."""
        return sum(self.refused.values()) + self.ignored

    def _forget_silent(self, now: float) -> bool:
        """Forget the nodes that have not reported for `_FORGET_S`; return whether there are any."""
        old = [node for node, heard_s in self._heard_s.items() if now - heard_s > _FORGET_S]
        for node in old:
            del self._producers[node], self._heard_s[node], self.refused[node]
        return bool(old)


class HealthRecords:
    """The newest health report of every node. Not thread-safe: its owner must lock it."""

    def __init__(self) -> None:
        self.records: dict[str, NodeRecord] = {}
        self._filter = HealthFilter()

    def add(self, health: Health, now: float | None = None) -> bool:
        """Store a health report that arrived at `now`, in seconds of `time.monotonic` (default: now).

        Return False, and count the report in the node's record, if it is of another process than the accepted
        one.
        """
        now = time.monotonic() if now is None else now
        if not self._filter.accepts(health, now):
            if (known := self.records.get(health.node)) is not None:
                known.refused = self._filter.refused.get(health.node, 0)
            return False
        while len(self.records) >= _MAX_NODES and health.node not in self.records:
            del self.records[min(self.records, key=lambda name: self.records[name].received_s)]
        record = self.records.setdefault(health.node, NodeRecord(health, now))
        ended = health.state == "failed" and record.health.state != "failed"  # reported by its supervisor
        if record.health.instance != health.instance or ended:
            record.earlier_losses.update(losses_of(record.health))
            record.earlier_results.update(results_of(record.health))
        if record.health.instance != health.instance:
            record.history.clear()
            record.starts += 1
            record.restarts_s.append(now)
        record.health, record.received_s = health, now
        record.history.append((now, health))
        while now - record.history[0][0] > _WINDOW_S:
            record.history.popleft()
        return True

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
