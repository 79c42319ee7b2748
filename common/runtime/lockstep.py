"""All nodes in one thread, as a discrete-event loop: same input, same bytes out.

Events are ordered by (time, topic row, order of creation). Time is the arrival time that sources
give. A node's modelled `step_cost_s` keeps it busy, so that what is `latest` is overtaken as it would
be on a slow machine, and reproducibly. The handlers are the same that run live.
"""

from __future__ import annotations

import hashlib
import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from beamsplat.common.messages import Message
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.jobs import JobQueue, LazyFuture
from beamsplat.common.runtime.mailbox import NO_PRODUCER, Envelope, Mailbox
from beamsplat.common.runtime.node import Job, Node, Output
from beamsplat.common.topics import ROW_NUMBER, TOPICS

_LAST_ROW = len(TOPICS)


@dataclass
class _Seat:
    """One node and what the loop knows of it."""

    node: Node
    mailbox: Mailbox
    jobs: JobQueue
    instance: str
    sequences: dict[str, int]
    source: Iterator[Any] | None
    busy_until_ns: int = 0
    ended: bool = False


class Lockstep:
    """The loop. `on_message` sees every message that any node sends, in order."""

    def __init__(self, nodes: list[Node], on_message: Callable[[Envelope], None] | None = None) -> None:
        self._on_message = on_message or (lambda envelope: None)
        self._seats = [_seat(node) for node in nodes]
        self._events: list[tuple[int, int, int, Callable[[int], None]]] = []
        self._created = 0
        self._consumers: dict[str, list[_Seat]] = {
            name: [s for s in self._seats if name in s.mailbox.counts] for name in TOPICS
        }

    def run(self) -> dict[str, Mailbox]:
        """Runs until all sources are exhausted and all nodes drained; mailboxes (counters) by node."""
        try:
            for seat in self._seats:
                seat.node.configure()
            produced = {name for seat in self._seats for name in seat.node.outputs}
            for name in TOPICS:
                if name not in produced:
                    self._end_topic(name, NO_PRODUCER, 0)
            for seat in self._seats:
                if seat.source is not None:
                    self._pull(seat, 0)
            while self._events:
                time_ns, _, _, act = heapq.heappop(self._events)
                act(time_ns)
        finally:
            for seat in self._seats:
                seat.node.close()
        return {seat.node.name: seat.mailbox for seat in self._seats}

    def _at(self, time_ns: int, row: int, act: Callable[[int], None]) -> None:
        self._created += 1
        heapq.heappush(self._events, (time_ns, row, self._created, act))

    def _pull(self, seat: _Seat, now_ns: int) -> None:
        """Schedules the next message of a source, or its end."""
        item = next(seat.source, None)
        if item is None:
            self._at(now_ns, _LAST_ROW, lambda t: self._end_node(seat, t))
            return
        seat.node.check_output(item.topic, item.message)
        at_ns = max(item.message.stamp_ns if item.at_ns is None else item.at_ns, now_ns)

        def act(time_ns: int) -> None:
            self._send(seat, item.topic, item.message, time_ns)
            self._pull(seat, time_ns)

        self._at(at_ns, ROW_NUMBER[item.topic], act)

    def _send(self, seat: _Seat, name: str, message: Message, time_ns: int) -> None:
        """Numbers a message, shows it to the observer and delivers it."""
        sequence = seat.sequences.get(name, 0)
        seat.sequences[name] = sequence + 1
        header = Header(message.stamp_ns, time_ns, 0, sequence, 0, seat.node.name, seat.instance)
        envelope = Envelope(name, header, message)
        self._on_message(envelope)
        for consumer in self._consumers[name]:
            self._emit(consumer, consumer.node.handle_arrival(name, message), time_ns)
            consumer.mailbox.put(envelope)
            self._step(consumer, time_ns)

    def _step(self, seat: _Seat, now_ns: int) -> None:
        """Lets a node handle what it can at this time."""
        if seat.ended:
            self._hear_answers(seat)
        while now_ns >= seat.busy_until_ns and (envelope := seat.mailbox.pop()) is not None:
            for name, result in seat.jobs.before_message(envelope.topic):
                self._emit(seat, seat.node.handle_job(name, result), now_ns)
            seat.busy_until_ns = now_ns + _ns(seat.node.config.step_cost_s)
            seat.node.on_header(envelope.header)
            self._emit(seat, seat.node.handle(envelope.topic, envelope.message), seat.busy_until_ns)
            if seat.busy_until_ns > now_ns:
                self._at(seat.busy_until_ns, _LAST_ROW, lambda t: self._step(seat, t))
        if seat.mailbox.ended and not seat.ended and now_ns >= seat.busy_until_ns:
            self._end_node(seat, now_ns)

    def _hear_answers(self, seat: _Seat) -> None:
        """What is fed back to a node that has ended is still heard; it has nothing more to say to it."""
        while (envelope := seat.mailbox.pop()) is not None:
            seat.node.on_header(envelope.header)
            for _ in seat.node.handle(envelope.topic, envelope.message):
                pass

    def _emit(self, seat: _Seat, outputs: Iterator[Output], time_ns: int) -> None:
        for output in outputs:
            if isinstance(output, Job):
                self._start(seat, output, time_ns)
            else:
                name, message = output
                self._at(
                    time_ns,
                    ROW_NUMBER[name],
                    lambda t, name=name, message=message: self._send(seat, name, message, t),
                )

    def _start(self, seat: _Seat, job: Job, time_ns: int) -> None:
        future = seat.jobs.start(job)
        if job.after is None:

            def act(time_ns: int) -> None:
                for name, result in seat.jobs.take(future):
                    self._emit(seat, seat.node.handle_job(name, result), time_ns)

            self._at(time_ns + _ns(seat.node.config.job_cost_s), _LAST_ROW, act)

    def _end_node(self, seat: _Seat, now_ns: int) -> None:
        """Last jobs and outputs of a node whose inputs have ended; then its own topics end."""
        seat.ended = True
        for name, result in seat.jobs.rest():
            self._emit(seat, seat.node.handle_job(name, result), now_ns)
        self._emit(seat, seat.node.handle_drain(), now_ns)
        for name in seat.node.outputs:
            self._at(now_ns, _LAST_ROW, lambda t, name=name: self._end_topic(name, seat.instance, t))

    def _end_topic(self, name: str, instance: str, now_ns: int) -> None:
        for consumer in self._consumers[name]:
            consumer.mailbox.end(name, instance, 0)
            self._step(consumer, now_ns)


def _seat(node: Node) -> _Seat:
    return _Seat(
        node=node,
        mailbox=Mailbox(type(node)),
        jobs=JobQueue(LazyFuture),
        instance=hashlib.sha256(node.name.encode()).hexdigest()[:16],
        sequences={},
        source=node.source() if node.is_source() else None,
    )


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
