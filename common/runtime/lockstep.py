"""Lockstep runner: all nodes in one thread, as a discrete-event simulation. Same input, same bytes.

Events are ordered by (time, topic row, order of creation). Time is the arrival time that sources
return. A node is busy for its modelled `step_cost_s` per message (`idle_cost_s` per piece of idle work), so
that `latest` inputs drop messages as they would on a slow machine, but reproducibly. The node handlers are
the same as in the live runner.
"""

from __future__ import annotations

import hashlib
import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from beamsplat.common.messages import Message
from beamsplat.common.messages.header import Header
from beamsplat.common.messages.instances import ProcessId
from beamsplat.common.runtime.jobs import JobQueue, LazyFuture
from beamsplat.common.runtime.mailbox import Envelope, Mailbox
from beamsplat.common.runtime.node import Job, Node, Output
from beamsplat.common.topics import ROW_NUMBER, TOPICS

_LAST_ROW = len(TOPICS)


@dataclass
class _NodeState:
    """A node with its mailbox, jobs and progress."""

    node: Node
    mailbox: Mailbox
    jobs: JobQueue[LazyFuture]
    instance: str
    sequences: dict[str, int]
    source: Iterator[Any] | None
    busy_until_ns: int = 0
    ended: bool = False


class Lockstep:
    """The event loop over all nodes. `on_message` is called with every published message, in event order."""

    def __init__(self, nodes: list[Node], on_message: Callable[[Envelope], None] | None = None) -> None:
        self._on_message = on_message or (lambda envelope: None)
        self._states = [_state_of(node) for node in nodes]
        self._events: list[tuple[int, int, int, Callable[[int], None]]] = []
        self._created = 0
        ignored = {id(s): s.node.ignored_inputs() for s in self._states}
        self._consumers: dict[str, list[_NodeState]] = {
            name: [s for s in self._states if name in s.mailbox.counts and name not in ignored[id(s)]]
            for name in TOPICS
        }

    def run(self) -> dict[str, Mailbox]:
        """Run until all sources are exhausted and all nodes drained.

        Returns:
            The mailbox of each node, with its message counters, by node name.
        """
        try:
            produced = {name for state in self._states for name in state.node.outputs}
            for state in self._states:
                state.node.without_producer = frozenset(state.mailbox.counts) - produced
                state.node.configure()
                for name in state.node.ignored_inputs() & state.mailbox.counts.keys():
                    state.mailbox.end(name, None)
            for name in TOPICS:
                if name not in produced:
                    self._end_topic(name, None, 0)
            for state in self._states:
                if state.source is not None:
                    self._pull(state, 0)
            time_ns = 0
            while self._events:
                time_ns, _, _, act = heapq.heappop(self._events)
                act(time_ns)
                if not self._events:
                    self._end_one_that_waits(time_ns)
        finally:
            for state in self._states:
                state.node.close()
        return {state.node.name: state.mailbox for state in self._states}

    def _at(self, time_ns: int, row: int, act: Callable[[int], None]) -> None:
        self._created += 1
        heapq.heappush(self._events, (time_ns, row, self._created, act))

    def _pull(self, state: _NodeState, now_ns: int) -> None:
        """Schedule the next message of a source, or its end."""
        assert state.source is not None  # called for sources only
        item = next(state.source, None)
        if item is None:
            self._at(now_ns, _LAST_ROW, lambda t: self._end_node(state, t))
            return
        state.node.check_output(item.topic, item.message)
        at_ns = max(item.message.stamp_ns if item.at_ns is None else item.at_ns, now_ns)

        def act(time_ns: int) -> None:
            self._send(state, item.topic, item.message, 0, time_ns)
            self._pull(state, time_ns)

        self._at(at_ns, ROW_NUMBER[item.topic], act)

    def _send(self, state: _NodeState, name: str, message: Message, backlog: int, time_ns: int) -> None:
        """Create the header of a message, pass both to `on_message`, and deliver them to all subscribers."""
        sequence = state.sequences.get(name, 0)
        state.sequences[name] = sequence + 1
        header = Header(message.stamp_ns, time_ns, 0, sequence, 0, state.node.name, state.instance, backlog)
        envelope = Envelope(name, header, message)
        self._on_message(envelope)
        for consumer in self._consumers[name]:
            self._emit(consumer, consumer.node.handle_arrival(name, message), time_ns)
            consumer.mailbox.put(envelope)
            self._step(consumer, time_ns)

    def _step(self, state: _NodeState, now_ns: int) -> None:
        """Let a node handle its queued messages until it is busy or its mailbox is empty."""
        if state.ended:
            self._handle_late_feedback(state)
        while now_ns >= state.busy_until_ns and (envelope := state.mailbox.pop()) is not None:
            for name, result in state.jobs.before_message(envelope.topic):
                self._emit(state, state.node.handle_job(name, result), now_ns)
            state.busy_until_ns = now_ns + _ns(state.node.config.step_cost_s)
            state.node.on_header(envelope.header)
            self._emit(state, state.node.handle(envelope.topic, envelope.message), state.busy_until_ns)
            if state.busy_until_ns > now_ns:
                self._at(state.busy_until_ns, _LAST_ROW, lambda t: self._step(state, t))
        while now_ns >= state.busy_until_ns and not (state.ended or state.mailbox.ended):
            if not state.node.has_idle_work():
                break
            state.busy_until_ns = now_ns + _ns(state.node.config.idle_cost_s)
            self._emit(state, state.node.handle_idle(), state.busy_until_ns)
            if state.busy_until_ns > now_ns:
                self._at(state.busy_until_ns, _LAST_ROW, lambda t: self._step(state, t))
        waits = state.mailbox.feedback_may_arrive and state.node.awaits_feedback()
        if state.mailbox.ended and not state.ended and not waits and now_ns >= state.busy_until_ns:
            self._end_node(state, now_ns)

    def _end_one_that_waits(self, now_ns: int) -> None:
        """End a node whose inputs have ended and whose feedback does not arrive any more."""
        for state in self._states:
            if state.mailbox.ended and not state.ended:
                self._end_node(state, now_ns)
                return

    def _handle_late_feedback(self, state: _NodeState) -> None:
        """Handle feedback for a node that has ended; its outputs are discarded."""
        while (envelope := state.mailbox.pop()) is not None:
            state.node.on_header(envelope.header)
            for _ in state.node.handle(envelope.topic, envelope.message):
                pass

    def _emit(self, state: _NodeState, outputs: Iterator[Output], time_ns: int) -> None:
        for output in outputs:
            if isinstance(output, Job):
                self._start(state, output, time_ns)
            else:
                name, message = output
                backlog = state.node.backlog(name)
                self._at(time_ns, ROW_NUMBER[name], partial(self._send, state, name, message, backlog))

    def _start(self, state: _NodeState, job: Job, time_ns: int) -> None:
        future = state.jobs.start(job)
        if job.after is None:

            def act(time_ns: int) -> None:
                for name, result in state.jobs.result_of(future):
                    self._emit(state, state.node.handle_job(name, result), time_ns)

            self._at(time_ns + _ns(state.node.config.job_cost_s), _LAST_ROW, act)

    def _end_node(self, state: _NodeState, now_ns: int) -> None:
        """Finish the jobs of a node whose inputs have ended, drain it, then end its output topics."""
        state.ended = True
        for name, result in state.jobs.remaining_results():
            self._emit(state, state.node.handle_job(name, result), now_ns)
        self._emit(state, state.node.handle_drain(), now_ns)
        process = ProcessId(state.node.name, 0, state.instance)
        for name in state.node.outputs:
            self._at(now_ns, _LAST_ROW, partial(self._end_topic, name, process))

    def _end_topic(self, name: str, process: ProcessId | None, now_ns: int) -> None:
        for consumer in self._consumers[name]:
            consumer.mailbox.end(name, process)
            self._step(consumer, now_ns)


def _state_of(node: Node) -> _NodeState:
    return _NodeState(
        node=node,
        mailbox=Mailbox(type(node)),
        jobs=JobQueue(LazyFuture),
        instance=hashlib.sha256(node.name.encode()).hexdigest()[:16],
        sequences={},
        source=node.source() if node.is_source() else None,
    )


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
