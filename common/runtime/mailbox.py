"""Input queues of a node: a ring per `latest` or `latched` input, queues merged by stamp for `every` inputs.

`every` inputs that are feedback, or whose topic has `history`, share a queue in order of arrival. A mailbox
belongs to one node and is not thread-safe; the live runner locks it. It counts dropped, lost, late, stale,
refused and undecodable messages per input.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from beamsplat.common.messages import InputHealth, Message
from beamsplat.common.messages.header import Header, local_clock_id
from beamsplat.common.messages.instances import ProcessId
from beamsplat.common.runtime.accepted_producer import SILENCE_S, AcceptedProducer
from beamsplat.common.runtime.node import Node, merged_topics, subscriptions
from beamsplat.common.runtime.sequence import MAX_JUMP, SequenceTracker
from beamsplat.common.runtime.stamp_merger import StampMerger
from beamsplat.common.topics import ROW_NUMBER, TOPICS

NO_PRODUCER = "nobody"  # instance that ends an input without a producer
MAX_QUEUED = 20_000  # messages per `every` input; beyond that the oldest is dropped and counted
_MAX_COUNT = 2**63 - 1  # largest int64: limit of the counters in a Health message


_MAX_OPEN = 10_000  # missing numbers of one gap that a hand-over passes on


# Topic -> instance of its producer -> (next expected sequence number, earlier ones queued or missing).
HandledSequences = dict[str, dict[str, tuple[int, list[int]]]]


@dataclass(frozen=True, slots=True)
class Envelope:
    """A received message with its topic, header and payload size."""

    topic: str
    header: Header
    message: Message
    size_bytes: int = 0  # of the payload; 0 in lockstep, where messages are not encoded


@dataclass
class InputCount:
    """Message counters of one input, its producer, and the sequence numbers from which losses are computed.

    The counters have the same meaning as in `messages.robot.InputHealth`.
    """

    received: int = 0
    dropped: int = 0
    lost: int = 0  # of earlier processes, or at the end of the stream; those of `sequence` are not included
    late: int = 0
    undecodable: int = 0
    stale: int = 0
    refused: int = 0
    age_ms: float = 0.0
    producer: AcceptedProducer = field(default_factory=AcceptedProducer)
    sequence: SequenceTracker = field(default_factory=lambda: SequenceTracker(None))
    arrival_ns: int = 0  # of the newest admitted message
    ended_by: str | None = None  # instance that ended the stream, or NO_PRODUCER
    elsewhere: bool = False  # the newest message was published on another host
    ended_after: int = 0  # number of messages that this instance has sent in all
    queued_bytes: int = 0


class Mailbox:
    """Queues and counters of all inputs of one node."""

    def __init__(self, node: type[Node], clock_ns: Callable[[], int] | None = None) -> None:
        """`clock_ns`: clock for time-outs in the live runner, None in lockstep; see `StampMerger`."""
        self._deliveries = {i.topic: i.effective_delivery for i in subscriptions(node)}
        self._merger = StampMerger(merged_topics(node), clock_ns=clock_ns)
        self._keep = {i.topic: i.keep for i in subscriptions(node)}
        self._rings: dict[str, deque[Envelope]] = {}  # of `latest` and `latched` inputs; none is empty
        self._feedback_topics = frozenset(i.topic for i in subscriptions(node) if i.feedback)
        self._merged_topics = frozenset(merged_topics(node))
        self._unmerged_queue: deque[Envelope] = deque()  # of all other `every` inputs
        self._most_bytes = {i.topic: i.queued_bytes for i in subscriptions(node)}
        self._clock_ns = clock_ns
        self._clock_id = 0 if clock_ns is None else local_clock_id()  # 0 in the headers of lockstep
        self._heard_ns: dict[str, int] = {}  # instance of an accepted producer -> last arrival on any input
        self._refused_latched: dict[str, Envelope] = {}  # topic -> newest message of a process without proof
        self.counts = {name: InputCount() for name in self._deliveries}

    def __len__(self) -> int:
        return len(self._merger) + sum(map(len, self._rings.values())) + len(self._unmerged_queue)

    def admit(self, envelope: Envelope) -> bool:
        """Count a received message, and return whether it is to be queued (`queue`).

        Not if it is repeated, of an earlier process of its producer, or of a process that is not accepted as
        the producer (`beamsplat.common.runtime.accepted_producer`).
        """
        count, header, now_ns = self.counts[envelope.topic], envelope.header, self._now_ns()
        process = ProcessId(header.producer, header.epoch, header.instance)
        if not self._accepts(count, process, now_ns, self._is_silent(count, now_ns)):
            if self._deliveries[envelope.topic] == "latched":  # it may be published only once
                self._refused_latched[envelope.topic] = envelope
            return False
        newest = count.sequence.next
        if newest is not None and header.sequence - newest > MAX_JUMP and not self._is_silent(count, now_ns):
            count.refused += 1  # else the messages that really follow would count as repeated
            return False
        if self._deliveries[envelope.topic] == "every":
            order = count.sequence.add(header.sequence, now_ns)
        elif newest is not None and header.sequence < newest:
            order = "repeated"
        else:  # nothing is recovered: a missing message was replaced by a newer one
            count.dropped += header.sequence - (header.sequence if newest is None else newest)
            count.sequence.next = header.sequence + 1
            order = "next"
        if order == "repeated":
            count.stale += 1
            return False
        count.late += order == "late"
        count.arrival_ns = self._heard_ns[header.instance] = now_ns
        count.elsewhere = header.clock_id != self._clock_id
        if header.instance != count.ended_by or header.sequence >= count.ended_after:
            count.ended_by = None
        return True

    def put(self, envelope: Envelope) -> bool:
        """Queue a message if it is admitted; return whether it is."""
        admitted = self.admit(envelope)
        if admitted:
            self.queue(envelope)
        return admitted

    def queue(self, envelope: Envelope) -> None:
        """Queue an admitted message."""
        count = self.counts[envelope.topic]
        if self._deliveries[envelope.topic] != "every":
            ring = self._rings.setdefault(envelope.topic, deque())
            if len(ring) >= self._keep[envelope.topic]:
                ring.popleft()
                count.dropped += 1
            ring.append(envelope)
        elif envelope.topic not in self._merged_topics:
            if len(self._unmerged_queue) >= MAX_QUEUED:
                self.counts[self._unmerged_queue.popleft().topic].dropped += 1
            self._unmerged_queue.append(envelope)
        else:
            self._make_room(envelope, count)
            self._merger.put(envelope.topic, envelope.message.stamp_ns, envelope, _precedes)
            if (
                count.ended_by is not None
            ):  # recovered after the end-of-stream marker: the stream has ended all the same
                self._merger.end(envelope.topic)

    def _now_ns(self) -> int:
        return self._clock_ns() if self._clock_ns else 0

    def _is_silent(self, count: InputCount, now_ns: int) -> bool:
        """Return whether nothing of the input's accepted producer arrived on any input for `SILENCE_S`."""
        current = count.producer.current
        if current is None or self._clock_ns is None:
            return current is None
        return now_ns - self._heard_ns.get(current.instance, count.arrival_ns) > SILENCE_S * 1e9

    def _accepts(self, count: InputCount, process: ProcessId, now_ns: int, silent: bool) -> bool:
        """Return whether `process` is the producer of an input, perhaps from now on; else count why not.

        `silent`: see `AcceptedProducer.judge`.
        """
        verdict = count.producer.judge(process, silent)
        if verdict in ("stale", "refused"):
            setattr(count, verdict, getattr(count, verdict) + 1)
            return False
        if verdict != "same":
            count.sequence.give_up(None)
            count.lost += count.sequence.lost
            count.sequence = SequenceTracker(0 if verdict == "successor" else None)
            accepted = {c.producer.current.instance for c in self.counts.values() if c.producer.current}
            self._heard_ns = {i: heard for i, heard in self._heard_ns.items() if i in accepted}
            self._heard_ns[process.instance] = count.arrival_ns = now_ns
        return True

    def _make_room(self, envelope: Envelope, count: InputCount) -> None:
        most_bytes = self._most_bytes[envelope.topic]
        while queued := self._merger.queued(envelope.topic):
            if queued < MAX_QUEUED and count.queued_bytes + envelope.size_bytes <= most_bytes:
                break
            count.queued_bytes -= self._merger.drop_oldest(envelope.topic).size_bytes
            count.dropped += 1
        count.queued_bytes += envelope.size_bytes

    def end(self, topic: str, process: ProcessId | None, sent: int = 0) -> bool:
        """Mark an input as ended: `process` has sent its last message, `sent` messages in all.

        Messages that have not arrived by now are lost. `process` = None: nothing publishes on this topic.
        Return False, and change nothing, if `process` is not accepted as the producer. For the end of a
        stream, a silence of its producer is not enough: a node whose inputs have all ended cannot go on.
        """
        count = self.counts[topic]
        if process is not None and not self._accepts(count, process, self._now_ns(), silent=False):
            return False
        count.ended_by, count.ended_after = process.instance if process else NO_PRODUCER, sent
        if self._deliveries[topic] == "every":
            count.lost += max(sent - self.next_sequence(topic, count.ended_by), 0)
            count.sequence.give_up(None)
            if topic in self._merged_topics:
                self._merger.end(topic)
        return True

    def next_sequence(self, topic: str, instance: str) -> int:
        """Return the next expected sequence number on `topic` from `instance`; 0 before the first message."""
        count = self.counts[topic]
        is_current = count.producer.current is not None and count.producer.current.instance == instance
        return (count.sequence.next or 0) if is_current else 0

    def silence_s(self, topic: str) -> float:
        """Return the time in s since the newest message on `topic`; infinite before the first one."""
        arrival_ns = self.counts[topic].arrival_ns
        return (self._now_ns() - arrival_ns) / 1e9 if arrival_ns else math.inf

    def queued(self) -> list[Envelope]:
        """Return the queued messages of the `every` inputs, input by input in order of arrival."""
        return [*self._unmerged_queue, *self._merger.items()]

    def handled(self) -> HandledSequences:
        """Return the sequence numbers that this node has handled on its `every` inputs.

        Returns:
            {topic: {producer instance: (next expected number, numbers that are queued or missing)}}. All
            numbers below the first value have been handled, except the latter.
        """
        handled: HandledSequences = {}
        for topic, delivery in self._deliveries.items():
            count = self.counts[topic]
            if delivery != "every" or count.producer.current is None or count.sequence.next is None:
                continue
            instance = count.producer.current.instance
            open_numbers = [
                q.header.sequence for q in self.queued() if q.topic == topic and q.header.instance == instance
            ]
            for start, end in count.sequence.missing():
                open_numbers += range(start, min(end, start + _MAX_OPEN))
            handled[topic] = {instance: (count.sequence.next, sorted(open_numbers))}
        return handled

    def pop(self) -> Envelope | None:
        """Remove and return the message to handle next, or None if none is ready.

        Order: `every` inputs that are not merged (feedback, history), then those that are merged by stamp,
        then the oldest message of the `latest` and `latched` inputs.
        """
        self._reconsider_refused()
        if self._unmerged_queue:
            envelope = self._unmerged_queue.popleft()
            self.counts[envelope.topic].received += 1
            return envelope
        merged = self._merger.pop()
        if merged is not None:
            envelope = merged[1]
            self.counts[envelope.topic].queued_bytes -= envelope.size_bytes
        elif self._rings:
            heads = (ring[0] for ring in self._rings.values())
            envelope = min(heads, key=lambda e: (e.message.stamp_ns, ROW_NUMBER[e.topic]))
            self._rings[envelope.topic].popleft()
            if not self._rings[envelope.topic]:
                del self._rings[envelope.topic]
        else:
            return None
        self.counts[envelope.topic].received += 1
        return envelope

    def _reconsider_refused(self) -> None:
        """Queue a latched message of a process without proof once its predecessor counts as silent."""
        for topic, envelope in list(self._refused_latched.items()):
            count = self.counts[topic]
            if self._is_silent(count, self._now_ns()):
                del self._refused_latched[topic]
                self.put(envelope)

    @property
    def ended(self) -> bool:
        """Whether all inputs have ended, at least one of them had a producer, and the queues are empty.

        Feedback inputs are not considered, because they end after this node.
        """
        enders = [count.ended_by for name, count in self.counts.items() if name not in self._feedback_topics]
        return not len(self) and all(enders) and any(e != NO_PRODUCER for e in enders)

    @property
    def feedback_may_arrive(self) -> bool:
        """Whether a feedback input has not ended yet."""
        return any(self.counts[name].ended_by is None for name in self._feedback_topics)

    def health(self) -> tuple[InputHealth, ...]:
        """Return the counters of all inputs, for the field `inputs` of a Health message."""
        return tuple(self._health_of(name, count) for name, count in self.counts.items())

    def _health_of(self, name: str, count: InputCount) -> InputHealth:
        count.sequence.give_up(self._now_ns())
        gone, dropped = count.lost + count.sequence.lost, count.dropped
        row = TOPICS[name]
        # The producer sends these messages again, or the bridge has not forwarded them.
        if row.gaps_are_filled or (row.thinned and count.elsewhere):
            gone, dropped = 0, dropped + gone
        return InputHealth(
            topic=name, received=count.received, dropped=min(dropped, _MAX_COUNT), lost=min(gone, _MAX_COUNT),
            late=count.late, undecodable=count.undecodable, stale=count.stale, refused=count.refused,
            age_ms=max(count.age_ms, 0.0),
        )  # fmt: skip


def _precedes(earlier: Envelope, later: Envelope) -> bool:
    """Return whether two messages of one process were published in this order."""
    a, b = earlier.header, later.header
    return a.instance == b.instance and a.sequence < b.sequence
