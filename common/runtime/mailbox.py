"""Input queues of a node: a slot per `latest` or `latched` input, queues merged by stamp for `every` inputs.

An `every` input that is feedback has a queue of its own. A mailbox belongs to one node and is not
thread-safe; the live runner locks it. It counts dropped, lost, stale and undecodable messages per input.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from beamsplat.common.messages import InputHealth, Message
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.node import Node, merged_topics, subscriptions
from beamsplat.common.runtime.stamp_merger import StampMerger
from beamsplat.common.topics import ROW_NUMBER, TOPICS

NO_PRODUCER = "nobody"  # instance that ends an input without a producer
MAX_QUEUED = 20_000  # messages per `every` input; beyond that the oldest is dropped and counted
_MAX_COUNT = 2**63 - 1  # largest int64: limit of the counters in a Health message


# Topic -> instance of its producer -> (next expected sequence number, earlier ones that are still queued).
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
    """Message counters of one input, and the sequence numbers from which losses are computed.

    The counters have the same meaning as in `messages.robot.InputHealth`.
    """

    received: int = 0
    dropped: int = 0
    lost: int = 0
    undecodable: int = 0
    stale: int = 0
    age_ms: float = 0.0
    epoch: int = -1
    expected: dict[str, int] = field(default_factory=dict)  # instance -> next sequence number
    ended_by: str | None = None  # instance that ended the stream, or NO_PRODUCER
    queued_bytes: int = 0


class Mailbox:
    """Queues and counters of all inputs of one node."""

    def __init__(self, node: type[Node], clock_ns: Callable[[], int] | None = None) -> None:
        """`clock_ns`: clock for time-outs in the live runner, None in lockstep; see `StampMerger`."""
        self._deliveries = {i.topic: i.effective_delivery for i in subscriptions(node)}
        self._merger = StampMerger(merged_topics(node), clock_ns=clock_ns)
        self._slots: dict[str, Envelope] = {}
        self._feedback_topics = frozenset(i.topic for i in subscriptions(node) if i.feedback)
        self._feedback_queue: deque[Envelope] = deque()  # of `every` inputs that are feedback
        self._most_bytes = {i.topic: i.queued_bytes for i in subscriptions(node)}
        self.counts = {name: InputCount() for name in self._deliveries}

    def __len__(self) -> int:
        return len(self._merger) + len(self._slots) + len(self._feedback_queue)

    def put(self, envelope: Envelope) -> bool:
        """Queue a message and return True, or return False if it is stale (repeated, or of a predecessor)."""
        count = self.counts[envelope.topic]
        every = self._deliveries[envelope.topic] == "every"
        if not self._admit(count, envelope.header, every and not TOPICS[envelope.topic].resent_until_ack):
            return False
        if envelope.topic in self._slots:
            count.dropped += 1
        if every and envelope.topic in self._feedback_topics:
            if len(self._feedback_queue) >= MAX_QUEUED:
                self.counts[self._feedback_queue.popleft().topic].dropped += 1
            self._feedback_queue.append(envelope)
        elif every:
            self._make_room(envelope, count)
            self._merger.put(envelope.topic, envelope.message.stamp_ns, envelope)
            if (
                count.ended_by is not None
            ):  # recovered after the end-of-stream marker: the stream has ended all the same
                self._merger.end(envelope.topic)
        else:
            self._slots[envelope.topic] = envelope
        return True

    def _make_room(self, envelope: Envelope, count: InputCount) -> None:
        most_bytes = self._most_bytes[envelope.topic]
        while queued := self._merger.queued(envelope.topic):
            if queued < MAX_QUEUED and count.queued_bytes + envelope.size_bytes <= most_bytes:
                break
            count.queued_bytes -= self._merger.drop_oldest(envelope.topic).size_bytes
            count.dropped += 1
        count.queued_bytes += envelope.size_bytes

    def _admit(self, count: InputCount, header: Header, loses: bool) -> bool:
        """Update epoch and sequence state; return False for a stale or repeated message."""
        if header.epoch < count.epoch:
            count.stale += 1
            return False
        first = 0 if 0 <= count.epoch < header.epoch else None  # a successor starts at sequence number 0
        if header.epoch > count.epoch:
            count.epoch = header.epoch
            count.expected.clear()
        expected = count.expected.get(header.instance, first)
        if expected is not None and header.sequence < expected:
            count.stale += 1  # recovery can deliver a message a second time
            return False
        if expected is not None:
            gap = header.sequence - expected
            if loses:
                count.lost += gap
            else:
                count.dropped += gap
        count.expected[header.instance] = header.sequence + 1
        if header.instance != count.ended_by:
            count.ended_by = None
        return True

    def end(self, topic: str, instance: str, epoch: int, sent: int = 0) -> None:
        """Mark an input as ended: its producer `instance` has sent its last message, `sent` messages in all.

        Messages that have not arrived by now are counted as lost, or as dropped on a topic whose producer
        resends messages until they are acknowledged.
        """
        count = self.counts[topic]
        if epoch < count.epoch:  # of a producer that has handed over
            return
        count.ended_by = instance
        if self._deliveries[topic] == "every":
            missing = max(sent - self.next_sequence(topic, instance), 0)
            if TOPICS[topic].resent_until_ack:
                count.dropped += missing
            else:
                count.lost += missing
            if topic not in self._feedback_topics:
                self._merger.end(topic)

    def next_sequence(self, topic: str, instance: str) -> int:
        """Return the next expected sequence number on `topic` from `instance`; 0 before the first message."""
        return self.counts[topic].expected.get(instance, 0)

    def queued(self) -> list[Envelope]:
        """Return the queued messages of the `every` inputs, input by input in order of arrival."""
        return [*self._feedback_queue, *self._merger.items()]

    def handled(self) -> HandledSequences:
        """Return the sequence numbers that this node has handled on its `every` inputs.

        Returns:
            {topic: {producer instance: (next expected number, numbers that are still queued)}}. All numbers
            below the first value have been handled, except the queued ones.
        """
        queued = self.queued()
        return {
            topic: {
                instance: (
                    next_one,
                    [q.header.sequence for q in queued if q.topic == topic and q.header.instance == instance],
                )
                for instance, next_one in self.counts[topic].expected.items()
            }
            for topic, delivery in self._deliveries.items()
            if delivery == "every"
        }

    def pop(self) -> Envelope | None:
        """Remove and return the message to handle next, or None if none is ready.

        Order: feedback, then the next message of the `every` inputs (merged by stamp), then the oldest
        message of the `latest` and `latched` inputs.
        """
        if self._feedback_queue:
            envelope = self._feedback_queue.popleft()
            self.counts[envelope.topic].received += 1
            return envelope
        merged = self._merger.pop()
        if merged is not None:
            envelope = merged[1]
            self.counts[envelope.topic].queued_bytes -= envelope.size_bytes
        elif self._slots:
            slots = self._slots.values()
            oldest = min(slots, key=lambda s: (s.message.stamp_ns, ROW_NUMBER[s.topic]))
            envelope = self._slots.pop(oldest.topic)
        else:
            return None
        self.counts[envelope.topic].received += 1
        return envelope

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
        return tuple(
            InputHealth(
                topic=name, received=c.received, dropped=min(c.dropped, _MAX_COUNT),
                lost=min(c.lost, _MAX_COUNT), undecodable=c.undecodable, stale=c.stale,
                age_ms=max(c.age_ms, 0.0),
            )
            for name, c in self.counts.items()
        )  # fmt: skip
