"""A node in a live process: inputs, outputs, background jobs and hand-over state, shared by its threads."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from typing import Any

from beamsplat.common.messages.header import Header, local_clock_id
from beamsplat.common.messages.instances import ProcessId
from beamsplat.common.messages.robot import NodeState
from beamsplat.common.runtime.handover import Handover
from beamsplat.common.runtime.health import HealthFilter
from beamsplat.common.runtime.jobs import JobQueue
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.mailbox import Envelope, Mailbox
from beamsplat.common.runtime.node import Job, Node, Output
from beamsplat.common.zenoh.streams import Publication

POLL_S = 0.2  # longest wait for a message before signals are checked
_FAULT_CHARS = 200
_END_TIMEOUT_S = 5.0  # an end-of-stream marker waits this long for messages still in transit
_END_SILENCE_S = 0.5  # and so long for a message that shows that the producer has not ended
_MAX_ENDS = 4  # markers per topic that wait: of one producer, or of few that are not accepted


class RunningNode:
    """The state that the threads of one live process share.

    The node's own thread calls `next_envelope`, `emit` and the job methods; bus threads call `receive`,
    `receive_end` and `wake`; the health thread reads counters. `changed` guards the mailbox.
    """

    def __init__(self, node: Node, settings: LiveSettings) -> None:
        self.node = node
        self.settings = node.live_settings = settings
        node.without_producer = settings.without_producer
        self.handover = Handover(settings.standby)
        self.accepts_arrivals = True  # whether `on_arrival` is called as soon as a message is received
        self.arrival_lock = threading.Lock()  # held during `on_arrival`: retiring waits for it
        self.mailbox = Mailbox(type(node), time.monotonic_ns)
        self.changed = threading.Condition()
        self.state: NodeState = "configure"
        self.detail = ""
        self._query_faults, self._last_query_fault = 0, ""
        self.steps_ms: deque[float] = deque(maxlen=512)
        self.publications: dict[str, Publication] = {}
        self.jobs: JobQueue[Future]  # set by the runner, before the node is configured
        self.undecodable_reports = 0  # health reports of other nodes
        self.reporters = HealthFilter()
        self.rejected_queries = 0
        # End-of-stream markers that wait: (topic, producer) -> (messages sent in all, time of arrival).
        self._ends: dict[tuple[str, ProcessId], tuple[int, float]] = {}
        self._clock_id = local_clock_id()

    # --- called from threads of the bus ---

    def receive(self, envelope: Envelope) -> None:
        """Pass an admitted message to the node's `on_arrival`, then put it into the mailbox."""
        with self.arrival_lock:
            with self.changed:
                if not self.mailbox.admit(envelope):
                    return
            # A message that the predecessor has handled may be recovered from the sender's cache later.
            handover = self.handover
            skip = handover.standby or handover.retired or handover.was_handled(envelope)
            if self.accepts_arrivals and not skip:
                self.emit(self.node.handle_arrival(envelope.topic, envelope.message))
            with self.changed:
                self.mailbox.queue(envelope)
                self.changed.notify()

    def receive_end(self, topic: str, header: Header, sent: int) -> None:
        """Record that the producer of `topic` in `header` has ended after publishing `sent` messages."""
        process = ProcessId(header.producer, header.epoch, header.instance)
        with self.changed:
            waiting = [producer for ended, producer in self._ends if ended == topic]
            if len(waiting) >= _MAX_ENDS and process not in waiting:
                self.mailbox.counts[topic].refused += 1
                return
            self._ends[topic, process] = (sent, time.monotonic())
            self.changed.notify()

    def wake(self) -> None:
        """Wake the node's thread from its wait for messages."""
        with self.changed:
            self.changed.notify()

    # --- called from the node's thread ---

    def count_query_fault(self, query: str, fault: str) -> None:
        """Count a query that ended with an exception of the node; `fault` names the exception."""
        self._query_faults, self._last_query_fault = self._query_faults + 1, f"{query}: {fault}"

    def detail_text(self) -> str:
        """Return the detail line of the node's health: of the runner, else of the node; failed queries."""
        texts = [self.detail or self.node.detail]
        if self._query_faults:
            noun = "query" if self._query_faults == 1 else "queries"
            texts.append(
                f"{self._query_faults} {noun} failed (last: {self._last_query_fault[:_FAULT_CHARS]})"
            )
        for name, publication in self.publications.items():
            if publication.refused:
                texts.append(f"{publication.refused} messages on {name} are too large and were not published")
        for name, count in self.mailbox.counts.items():
            if count.refused:
                texts.append(
                    f"{count.refused} messages on {name} refused: of another process than its producer"
                )
        others = (
            (self.undecodable_reports, "health reports could not be decoded"),
            (self.reporters.total_refused, "health reports refused: of another process than the node's"),
            (self.rejected_queries, "queries rejected: too many at once"),
        )
        texts += [f"{number} {what}" for number, what in others if number]
        return "; ".join(text for text in texts if text)

    def next_envelope(self, wait: bool = True) -> Envelope | None:
        """Return the next message for the node, or None if there is none, after waiting `POLL_S` for one."""
        with self.changed:
            self._apply_ends()
            envelope = self.mailbox.pop()
            if envelope is None and wait and not self.mailbox.ended:
                self.changed.wait(POLL_S)
                self._apply_ends()
                envelope = self.mailbox.pop()
            if envelope is not None:
                age_ns = envelope.header.age_ns(time.monotonic_ns(), self._clock_id)
                self.mailbox.counts[envelope.topic].age_ms = 0.0 if age_ns is None else age_ns / 1e6
        return envelope

    def _apply_ends(self) -> None:
        """End an input once all messages that its producer sent have arrived, or after a time-out.

        Meanwhile the input must be silent: a marker of somebody else must not end a stream that goes on.
        """
        now = time.monotonic()
        for (topic, process), (sent, arrived) in list(self._ends.items()):
            complete = self.mailbox.next_sequence(topic, process.instance) >= sent
            silence_s = min(self.mailbox.silence_s(topic), now - arrived)
            if silence_s < (_END_SILENCE_S if complete else _END_TIMEOUT_S):
                continue
            self.mailbox.end(topic, process, sent)  # refused and counted if it is not of the producer
            del self._ends[topic, process]

    def emit(self, outputs: Iterator[Output]) -> None:
        """Publish the messages and start the jobs in `outputs`; in standby, messages are stored instead."""
        for output in outputs:
            if isinstance(output, Job):
                self.jobs.start(output).add_done_callback(lambda _: self.wake())
            elif not self.handover.holds_back(*output):
                self.publications[output[0]].put(output[1], self.node.backlog(output[0]))

    def emit_results(self, results: Iterator[tuple[str, Any]]) -> None:
        """Pass the results of background jobs, as (name, result), to the node and emit its outputs."""
        for name, result in results:
            self.emit(self.node.handle_job(name, result))

    def finish_jobs(self) -> None:
        """Wait for all background jobs, pass their results to the node, and emit its outputs."""
        self.emit_results(self.jobs.remaining_results())
