"""Where a node's inputs wait: a slot per `latest` input, merged queues for the `every` ones; an `every`
input that is fed back waits in a queue of its own.

One mailbox belongs to one node and is not thread-safe by itself; the live runner holds a lock around
it. Whatever is overtaken, lost, stale or undecodable is counted here, per input.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from beamsplat.common.messages import InputHealth, Message
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.node import Input, Node, merged_topics
from beamsplat.common.runtime.stamp_merger import StampMerger
from beamsplat.common.topics import ROW_NUMBER, TOPICS

NO_PRODUCER = "nobody"  # ends an input that no node produces
MAX_QUEUED = 20_000  # of an `every` input: beyond it the oldest goes, and is counted
_MAX_COUNT = 2**63 - 1  # what a Health message can say


# Topic -> instance of its producer -> (sequence that should come next, those before it that still wait).
Handled = dict[str, dict[str, tuple[int, list[int]]]]


@dataclass(frozen=True, slots=True)
class Envelope:
    """A received message with what rode beside it."""

    topic: str
    header: Header
    message: Message
    size_bytes: int = 0  # of the payload; 0 where there was none


@dataclass
class InputCount:
    """Counters of one input, and what they are made from."""

    received: int = 0
    dropped: int = 0
    lost: int = 0
    undecodable: int = 0
    stale: int = 0
    age_ms: float = 0.0
    epoch: int = -1
    expected: dict[str, int] = field(default_factory=dict)  # instance -> next sequence
    ended_by: str | None = None
    queued_bytes: int = 0


class Mailbox:
    """The inputs of one node."""

    def __init__(self, node: type[Node], clock_ns: Callable[[], int] | None = None) -> None:
        """`clock_ns` is given live: see `StampMerger`."""
        self._deliveries = {i.topic: i.effective_delivery for i in _inputs(node)}
        self._merger = StampMerger(merged_topics(node), clock_ns=clock_ns)
        self._slots: dict[str, Envelope] = {}
        self._fed_back = frozenset(i.topic for i in _inputs(node) if i.feedback)
        self._answers: deque[Envelope] = deque()  # of `every` inputs that are fed back
        self._most_bytes = {i.topic: i.queued_bytes for i in _inputs(node)}
        self.counts = {name: InputCount() for name in self._deliveries}

    def __len__(self) -> int:
        return len(self._merger) + len(self._slots) + len(self._answers)

    def put(self, envelope: Envelope) -> bool:
        """Takes a envelope, unless its epoch has been taken over; True if it was taken."""
        count = self.counts[envelope.topic]
        every = self._deliveries[envelope.topic] == "every"
        if not self._admit(count, envelope.header, every and not TOPICS[envelope.topic].resent_until_ack):
            return False
        if envelope.topic in self._slots:
            count.dropped += 1
        if every and envelope.topic in self._fed_back:
            if len(self._answers) >= MAX_QUEUED:
                self.counts[self._answers.popleft().topic].dropped += 1
            self._answers.append(envelope)
        elif every:
            self._make_room(envelope, count)
            self._merger.put(envelope.topic, envelope.message.stamp_ns, envelope)
            if count.ended_by is not None:  # a straggler: its producer has ended all the same
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
        """Epoch and sequence bookkeeping; False for a stale or repeated message."""
        if header.epoch < count.epoch:
            count.stale += 1
            return False
        first = 0 if 0 <= count.epoch < header.epoch else None  # a successor starts counting at 0
        if header.epoch > count.epoch:
            count.epoch = header.epoch
            count.expected.clear()
        expected = count.expected.get(header.instance, first)
        if expected is not None and header.sequence < expected:
            count.stale += 1  # recovery may deliver once more what has arrived
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
        """The producer `instance` says that nothing more will come on `topic`, after `sent` messages; what
        of them has not come by now counts as lost."""
        count = self.counts[topic]
        if epoch < count.epoch:  # of a producer that has been taken over
            return
        count.ended_by = instance
        if self._deliveries[topic] == "every":
            missing = max(sent - self.next_sequence(topic, instance), 0)
            if TOPICS[topic].resent_until_ack:
                count.dropped += missing
            else:
                count.lost += missing
            if topic not in self._fed_back:
                self._merger.end(topic)

    def next_sequence(self, topic: str, instance: str) -> int:
        """The sequence number that `topic` should bring next from `instance`; 0 before the first."""
        return self.counts[topic].expected.get(instance, 0)

    def waiting(self) -> list[Envelope]:
        """What of the `every` inputs waits here, input by input in order of arrival."""
        return [*self._answers, *self._merger.items()]

    def handled(self) -> Handled:
        """What of the `every` inputs has come and does not wait here any more."""
        queued = self.waiting()
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
        """The envelope to handle next: answers, what is certain of `every` inputs, the oldest of the rest."""
        if self._answers:
            envelope = self._answers.popleft()
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
        """Every input has ended, at least one by its producer's word, and everything was handed out. Inputs
        that are fed back are not asked: they end after this node."""
        enders = [count.ended_by for name, count in self.counts.items() if name not in self._fed_back]
        return not len(self) and all(enders) and any(e != NO_PRODUCER for e in enders)

    @property
    def feedback_may_arrive(self) -> bool:
        """Somebody feeds back to this node, and has not ended."""
        return any(self.counts[name].ended_by is None for name in self._fed_back)

    def health(self) -> tuple[InputHealth, ...]:
        """The counters as they go into a Health message."""
        return tuple(
            InputHealth(
                topic=name, received=c.received, dropped=min(c.dropped, _MAX_COUNT),
                lost=min(c.lost, _MAX_COUNT), undecodable=c.undecodable, stale=c.stale,
                age_ms=max(c.age_ms, 0.0),
            )
            for name, c in self.counts.items()
        )  # fmt: skip


def _inputs(node: type[Node]) -> tuple[Input, ...]:
    return tuple(i for i in node.inputs if isinstance(i, Input))
