"""Live runner: runs one node as one process on Zenoh.

Threads: the main thread runs the node; one per subscription fills the mailbox; two run background jobs; one
publishes health every second. A node's handlers are called from the main thread only, except `on_arrival`.
"""

from __future__ import annotations

import logging
import math
import signal
import time
from collections import deque
from collections.abc import Iterator
from functools import partial

import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import ReplayPosition
from beamsplat.common.messages import Health, Message
from beamsplat.common.runtime.control import HandoverControl
from beamsplat.common.runtime.handover import CONTROL
from beamsplat.common.runtime.health_reporter import HealthReporter
from beamsplat.common.runtime.jobs import JobAbandoned, JobQueue, JobThreads
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.node import Node, StopRequested, subscriptions
from beamsplat.common.runtime.pacing import Playback, wait_for_nodes
from beamsplat.common.runtime.rate_limited_log import RateLimitedLog
from beamsplat.common.runtime.running_node import POLL_S, RunningNode
from beamsplat.common.security.logins import login_of
from beamsplat.common.topics import HEALTH
from beamsplat.common.zenoh.bus import IMAGE_POOL_BYTES, SHM_POOL_BYTES, Bus, open_session
from beamsplat.common.zenoh.queries import ask, reject, reply

log = logging.getLogger(__name__)

_MAX_QUERIES = 64  # that wait for the node's thread; a node may be busy with one step for some seconds
_MATCHING_S = 0.5  # a topic without subscribers delays the start of a source by this
_STOP_TIMEOUT_S = 2.0  # after a signal, background jobs have this long to finish
_FEEDBACK_TIMEOUT_S = 1.0  # without feedback, after which `on_feedback_timeout` is called


class Live:
    """Runs one node until its inputs end or a signal arrives."""

    def __init__(self, node: Node, settings: LiveSettings) -> None:
        self.running = RunningNode(node, settings)
        self._stopping = False
        self._stop_by = math.inf
        node.must_stop = lambda: self._stopping
        self._queries: deque[tuple[str, zenoh.Query]] = deque()
        self._healths: deque[Health] = deque(maxlen=256)
        self._undecodable_limit = RateLimitedLog()
        self._position = ReplayPosition(settings.run_dir, node.name)

    def run(self) -> None:
        """Run the node through its life cycle: configure, standby, active, drain, drained, closed."""
        r = self.running
        settings, node = r.settings, r.node
        if not settings.resume:  # else a crash before the first message would resume an earlier run
            self._position.clear()
        try:
            login = login_of(settings.security, node.name)
            session = open_session(
                settings.endpoints, should_stop=lambda: self._stopping, login=login,
                pool_bytes=IMAGE_POOL_BYTES if "camera/image" in node.outputs else SHM_POOL_BYTES,
            )  # fmt: skip
        except UserError:
            if self._stopping:
                return
            raise
        with Bus(session, settings.robot, node.name, settings.instance, settings.epoch) as bus:
            reporter = HealthReporter(r, bus)
            r.jobs = JobQueue(JobThreads(self._must_abandon).submit)
            node.set_query_function(partial(ask, session, settings.robot))
            try:
                node.configure()
                r.state = "standby"
                self._control = HandoverControl(r, bus)
                self._join(bus)
                self._work(bus)
                reporter.send()
            except JobAbandoned:
                log.warning("stopped while a background job was running: its result is lost")
            except StopRequested:
                log.info("stopped while starting")
            finally:
                r.state = "closed"
                node.close()

    def stop(self, *_: object) -> None:
        """Request the end of the node's main loop, and return at once; safe in a signal handler."""
        self._stopping = True
        self._stop_by = min(self._stop_by, time.monotonic() + _STOP_TIMEOUT_S)

    def _must_abandon(self) -> bool:
        return time.monotonic() > self._stop_by

    def install_signal_handlers(self) -> None:
        """Let SIGINT and SIGTERM end the node cleanly."""
        signal.signal(signal.SIGINT, self.stop)
        signal.signal(signal.SIGTERM, self.stop)

    def _join(self, bus: Bus) -> None:
        r = self.running
        # Assigned as a whole: the health thread iterates over it meanwhile.
        r.publications = {name: bus.publish(name) for name in r.node.outputs}
        ignored = r.node.ignored_inputs()
        for entry in subscriptions(type(r.node)):
            if entry.topic in r.settings.without_producer or entry.topic in ignored:
                r.mailbox.end(entry.topic, None)
            if entry.topic in ignored:
                continue
            bus.subscribe(entry, r.receive, self._on_undecodable, r.receive_end)
        if r.node.watches_health():
            bus.watch_health(self._on_health, self._on_undecodable)
        bus.answer_queries(self._on_query)
        if not r.handover.standby:
            bus.announce(r.node.queries())

    def _work(self, bus: Bus) -> None:
        r = self.running
        if r.node.is_source():
            self._wait_for_consumers(bus)
            r.state = "active"
            self._run_source()
        else:
            if not r.handover.standby:
                r.state = "active"
            self._run_steps()
        if r.handover.retired or r.handover.standby:
            return
        finished = not self._stopping
        r.state = "drain"
        r.finish_jobs()
        r.emit(r.node.handle_drain())
        r.finish_jobs()
        r.state = "drained"
        if finished:  # stopped by a signal, it leaves the stream open for a successor
            self._position.finish()
            for publication in r.publications.values():
                bus.end(publication)
            while not (self._stopping or r.settings.exit_when_drained or r.handover.retired):
                self._process_requests()
                self._handle_late_feedback()
                with r.changed:
                    r.changed.wait(POLL_S)

    def _handle_late_feedback(self) -> None:
        """Handle feedback that arrives after the node has ended; its outputs are discarded."""
        r = self.running
        while (envelope := r.next_envelope()) is not None:
            r.node.on_header(envelope.header)
            for _ in r.node.handle(envelope.topic, envelope.message):
                pass

    # --- the node's own thread ---

    def _run_steps(self) -> None:
        r = self.running
        last_received = time.monotonic()
        while not self._stopping:
            self._process_requests()
            if r.handover.retired:
                return
            if r.handover.standby and r.node.hands_over:
                with r.changed:  # messages wait until this process has the predecessor's state
                    r.changed.wait(POLL_S)
                continue
            envelope = r.next_envelope(wait=not r.node.has_idle_work())
            r.emit_results(r.jobs.finished())
            if envelope is None:
                if not r.mailbox.ended:
                    if r.node.has_idle_work():
                        r.emit(r.node.handle_idle())
                else:
                    if not (r.mailbox.feedback_may_arrive and r.node.awaits_feedback()):
                        return
                    last_received = self._check_feedback_timeout(last_received)
                continue
            last_received = time.monotonic()
            if r.handover.was_handled(envelope):
                continue
            started = time.perf_counter()
            r.emit_results(r.jobs.before_message(envelope.topic))
            r.node.on_header(envelope.header)
            r.emit(r.node.handle(envelope.topic, envelope.message))
            r.steps_ms.append((time.perf_counter() - started) * 1e3)

    def _check_feedback_timeout(self, last_received: float) -> float:
        """Call `on_feedback_timeout` when feedback is missing; return the start of the next time-out."""
        waited_s = time.monotonic() - last_received
        if waited_s < _FEEDBACK_TIMEOUT_S:
            time.sleep(0.02)  # `next_envelope` does not wait once the inputs have ended
            return last_received
        self.running.emit(self.running.node.handle_feedback_timeout(waited_s))
        return last_received + waited_s

    def _run_source(self) -> None:
        r = self.running
        playback = Playback(r.settings.rate, self._position, r.settings.resume)
        for item in r.node.source():
            if item is None:  # a device without a new measurement
                self._process_requests()
                if self._stopping:
                    return
                continue
            while not self._stopping and (wait_s := playback.wait_s(item)) > 0.0:
                self._process_requests()
                time.sleep(min(wait_s, POLL_S))
            if self._stopping:
                return
            self._process_requests()
            started = time.perf_counter()
            r.node.check_output(item.topic, item.message)
            publication = r.publications[item.topic]
            if playback.is_past(item) and publication.row.delivery != "latched":
                continue
            publication.put(item.message)
            r.steps_ms.append((time.perf_counter() - started) * 1e3)
            playback.mark_published(item)

    def _wait_for_consumers(self, bus: Bus) -> None:
        r = self.running

        def on_waiting(missing: list[str]) -> None:
            r.detail = f"waiting for {', '.join(missing)}"

        def settled() -> set[str]:
            return bus.alive_nodes() | bus.failed_nodes()

        wait_for_nodes(settled, r.settings, lambda: self._stopping, on_waiting)
        if r.settings.wait_for:
            bus.wait_for_subscribers(tuple(r.publications), _MATCHING_S)
        r.detail = ""

    def _process_requests(self) -> None:
        """Process the health reports and queries received since the last call."""
        node = self.running.node
        while self._healths:
            node.on_health(self._healths.popleft())
        while self._queries:
            name, query = self._queries.popleft()
            if fault := reply(query, self._answers(name, query)):
                self.running.count_query_fault(name, fault)

    def _answers(self, name: str, query: zenoh.Query) -> Iterator[Message]:
        """Yield the answers to a query; exceptions are raised while iterating, where `reply` sends them."""
        # The stubs miss that Parameters iterates over (key, value).
        parameters: dict[str, str] = dict(query.parameters)  # type: ignore[call-overload]
        if name.startswith(CONTROL):
            yield from self._control.answer(name.removeprefix(CONTROL + "/"), parameters)
        else:
            yield from getattr(self.running.node, f"on_query_{name}")(parameters)

    # --- called from threads of the bus ---

    def _on_undecodable(self, topic: str, reason: str) -> None:
        r = self.running
        with r.changed:
            if topic == HEALTH:
                r.undecodable_reports += 1
            else:
                r.mailbox.counts[topic].undecodable += 1
            count = self._undecodable_limit.due(topic)
        if count is not None:
            log.warning("dropped a message on %s (%d more since the last report): %s", topic, count, reason)

    def _on_query(self, name: str, query: zenoh.Query) -> None:
        if len(self._queries) >= _MAX_QUERIES * (2 if name.startswith(CONTROL) else 1):
            self.running.rejected_queries += 1
            reject(query, f"{self.running.node.name} has {_MAX_QUERIES} queries to answer: ask again later")
            return
        self._queries.append((name, query))
        self.running.wake()

    def _on_health(self, health: Health) -> None:
        if self.running.reporters.accepts(health, time.monotonic()):
            self._healths.append(health)
            self.running.wake()
