"""Where a node's inputs wait: a slot per `latest` input, merged queues for the `every` ones.

One mailbox belongs to one node and is not thread-safe by itself; the live runner holds a lock around
it. Whatever is overtaken, lost, stale or undecodable is counted here, per input.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from common.header import Header
from common.messages import InputHealth, Message
from common.node import Input, Node, merged_topics
from common.sync import StampMerger
from common.topics import ROW_NUMBER

NOBODY = "nobody"  # ends an input that no node produces
MAX_QUEUED = 20_000  # of an `every` input: beyond it the oldest goes, and is counted


@dataclass(frozen=True, slots=True)
class Letter:
    """A received message with what rode beside it."""

    topic: str
    header: Header
    message: Message


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


class Mailbox:
    """The inputs of one node."""

    def __init__(self, node: type[Node]) -> None:
        self._deliveries = {i.topic: i.effective_delivery for i in _inputs(node)}
        self._merger = StampMerger(merged_topics(node))
        self._slots: dict[str, Letter] = {}
        self.counts = {name: InputCount() for name in self._deliveries}

    def __len__(self) -> int:
        return len(self._merger) + len(self._slots)

    def put(self, letter: Letter) -> bool:
        """Takes a letter, unless its epoch has been taken over; True if it was taken."""
        count = self.counts[letter.topic]
        every = self._deliveries[letter.topic] == "every"
        if not self._admit(count, letter.header, every):
            return False
        if letter.topic in self._slots:
            count.dropped += 1
        if every:
            if self._merger.queued(letter.topic) >= MAX_QUEUED:
                self._merger.drop_oldest(letter.topic)
                count.dropped += 1
            self._merger.reopen(letter.topic)
            self._merger.put(letter.topic, letter.message.stamp_ns, letter)
        else:
            self._slots[letter.topic] = letter
        return True

    def _admit(self, count: InputCount, header: Header, every: bool) -> bool:
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
            if every:
                count.lost += gap
            else:
                count.dropped += gap
        count.expected[header.instance] = header.sequence + 1
        count.ended_by = None
        return True

    def end(self, topic: str, instance: str, epoch: int) -> None:
        """The producer `instance` says that nothing more will come on `topic`."""
        count = self.counts[topic]
        if epoch < count.epoch:  # of a producer that has been taken over
            return
        count.ended_by = instance
        if self._deliveries[topic] == "every":
            self._merger.end(topic)

    def next_sequence(self, topic: str, instance: str) -> int:
        """The sequence number that `topic` should bring next from `instance`; 0 before the first."""
        return self.counts[topic].expected.get(instance, 0)

    def pop(self) -> Letter | None:
        """The letter to handle next: the oldest of what is certain, by (stamp, row)."""
        slot = min(
            self._slots.values(), key=lambda s: (s.message.stamp_ns, ROW_NUMBER[s.topic]), default=None
        )
        merged = self._merger.pop()
        if merged is not None:
            letter = merged[1]
        elif slot is not None:
            letter = self._slots.pop(slot.topic)
        else:
            return None
        self.counts[letter.topic].received += 1
        return letter

    @property
    def ended(self) -> bool:
        """Every input has ended, at least one by its producer's word, and everything was handed out."""
        enders = [count.ended_by for count in self.counts.values()]
        return not len(self) and all(enders) and any(e != NOBODY for e in enders)

    def health(self) -> tuple[InputHealth, ...]:
        """The counters as they go into a Health message."""
        return tuple(
            InputHealth(
                topic=name, received=c.received, dropped=c.dropped, lost=c.lost,
                undecodable=c.undecodable, stale=c.stale, age_ms=max(c.age_ms, 0.0),
            )
            for name, c in self.counts.items()
        )  # fmt: skip


def _inputs(node: type[Node]) -> tuple[Input, ...]:
    return tuple(i for i in node.inputs if isinstance(i, Input))
