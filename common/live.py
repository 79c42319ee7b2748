"""One node as one process on Zenoh.

Threads: the main thread runs the node; one per subscription fills the mailbox; one works off
background jobs; one reports health every second. The node itself never sees any of them.
"""

from __future__ import annotations

import logging
import math
import secrets
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import psutil
import zenoh

from common.bus import Bus, open_session
from common.complaints import Complaints
from common.errors import UserError
from common.header import local_clock_id
from common.jobs import Abandoned, JobQueue, Worker
from common.live_settings import LiveSettings
from common.mailbox import NOBODY, Letter, Mailbox
from common.messages import Health, OutputHealth
from common.node import Job, Node, Output
from common.pacing import Playback
from common.persist import Bookmark, claim_epoch
from common.queries import reply
from common.streams import Publication

log = logging.getLogger(__name__)

_POLL_S = 0.2  # how soon a signal is noticed while nothing arrives
_STOP_PATIENCE_S = 2.0  # after a signal, background jobs have so long to finish
_END_PATIENCE_S = 5.0  # an end marker waits this long for messages still on their way
_DETAIL_CHARS = 2000


class Live:
    """Runs one node until its inputs end or a signal comes."""

    def __init__(self, node: Node, settings: LiveSettings) -> None:
        self.node = node
        self.settings = settings
        self.instance = secrets.token_hex(8)
        self.mailbox = Mailbox(type(node), time.monotonic_ns)
        self._changed = threading.Condition()
        self._stopping = False
        self._stop_by = math.inf
        self._state = "configure"
        self._detail = ""
        self._queries: deque[tuple[str, zenoh.Query]] = deque()
        self._healths: deque[Health] = deque(maxlen=256)
        self._ends: list[tuple[str, str, int, int, float]] = []
        self._steps_ms: deque[float] = deque(maxlen=512)
        self._publications: dict[str, Publication] = {}
        self._complaints = Complaints()
        self._bookmark = Bookmark(settings.run_dir, node.name)
        self._clock_id = local_clock_id()
        self._process = psutil.Process()
        self._process.cpu_percent()  # the first call only starts the measurement

    def run(self) -> None:
        """Life of the process: configure, standby, active, drain, drained, closed."""
        epoch = claim_epoch(self.settings.run_dir, self.node.name)
        if not self.settings.resume:  # an earlier run's: a crash before the first message must not lead there
            self._bookmark.clear()
        try:
            session = open_session(self.settings.endpoints, gave_up=lambda: self._stopping)
        except UserError:
            if self._stopping:
                return
            raise
        with Bus(session, self.settings.robot, self.node.name, self.instance, epoch) as bus:
            threading.Thread(target=self._report, args=(bus,), name="health", daemon=True).start()
            self._jobs = JobQueue(Worker(self._gave_up).submit)
            try:
                self.node.configure()
                self._state = "standby"
                self._join(bus)
                self._work(bus)
                self._send_health(bus)
            except Abandoned:
                log.warning("stopped in the middle of a background job: its result is lost")
            finally:
                self._state = "closed"
                self.node.close()

    def stop(self, *_: object) -> None:
        """Asks the node to end; safe in a signal handler."""
        self._stopping = True
        self._stop_by = min(self._stop_by, time.monotonic() + _STOP_PATIENCE_S)

    def _gave_up(self) -> bool:
        return time.monotonic() > self._stop_by

    def install_signal_handlers(self) -> None:
        """SIGINT and SIGTERM end the node cleanly."""
        signal.signal(signal.SIGINT, self.stop)
        signal.signal(signal.SIGTERM, self.stop)

    def _join(self, bus: Bus) -> None:
        # Assigned as a whole: the health thread goes through it meanwhile.
        self._publications = {name: bus.publish(name) for name in self.node.outputs}
        for entry in self.node.inputs:
            if entry.topic in self.settings.unfed:
                self.mailbox.end(entry.topic, NOBODY, 0)
            bus.subscribe(entry, self._on_letter, self._on_undecodable, self._on_end)
        for name in self.node.queries():
            bus.answer(name, self._on_query)
        if self.node.watches_health():
            bus.watch_health(self._on_health)
        bus.declare_alive()

    def _work(self, bus: Bus) -> None:
        if self.node.is_source():
            self._wait_for_consumers(bus)
            self._state = "active"
            self._run_source()
        else:
            self._state = "active"
            self._run_steps()
        finished = not self._stopping
        self._state = "drain"
        for name, result in self._jobs.rest():
            self._emit(self.node.handle_job(name, result))
        self._emit(self.node.handle_drain())
        self._state = "drained"
        if finished:  # stopped by a signal it leaves the stream open: a successor goes on
            self._bookmark.finish()
            for publication in self._publications.values():
                bus.end(publication)
            while not self._stopping and not self.settings.exit_when_drained:
                self._attend()
                self._hear_answers()
                with self._changed:
                    self._changed.wait(_POLL_S)

    def _hear_answers(self) -> None:
        """What is fed back to a node that has ended is still heard; it has nothing more to say to it."""
        while (letter := self._next()) is not None:
            self.node.on_header(letter.header)
            for _ in self.node.handle(letter.topic, letter.message):
                pass

    # --- the node's own thread ---

    def _run_steps(self) -> None:
        while not self._stopping:
            self._attend()
            letter = self._next()
            self._emit_all(self._jobs.finished())
            if letter is None:
                if self.mailbox.ended:
                    return
                continue
            started = time.perf_counter()
            self._emit_all(self._jobs.before_message(letter.topic))
            self.node.on_header(letter.header)
            self._emit(self.node.handle(letter.topic, letter.message))
            self._steps_ms.append((time.perf_counter() - started) * 1e3)

    def _next(self) -> Letter | None:
        """The next letter, or None after a short wait."""
        with self._changed:
            self._apply_ends()
            letter = self.mailbox.pop()
            if letter is None and not self.mailbox.ended:
                self._changed.wait(_POLL_S)
                self._apply_ends()
                letter = self.mailbox.pop()
            if letter is not None:
                age_ns = letter.header.age_ns(time.monotonic_ns(), self._clock_id)
                self.mailbox.counts[letter.topic].age_ms = 0.0 if age_ns is None else age_ns / 1e6
        return letter

    def _apply_ends(self) -> None:
        """Lets an input end once all that its producer sent has come, or is given up."""
        waiting = []
        for topic, instance, epoch, sent, deadline in self._ends:
            if self.mailbox.next_sequence(topic, instance) >= sent or time.monotonic() > deadline:
                self.mailbox.end(topic, instance, epoch, sent)
            else:
                waiting.append((topic, instance, epoch, sent, deadline))
        self._ends = waiting

    def _emit_all(self, results: Iterator[tuple[str, Any]]) -> None:
        for name, result in results:
            self._emit(self.node.handle_job(name, result))

    def _emit(self, outputs: Iterator[Output]) -> None:
        for output in outputs:
            if isinstance(output, Job):
                future = self._jobs.start(output)
                future.add_done_callback(lambda _: self._wake())
            else:
                self._publications[output[0]].put(output[1])

    def _run_source(self) -> None:
        playback = Playback(self.settings.rate, self._bookmark, self.settings.resume)
        for item in self.node.source():
            if item is None:  # a device with nothing to say just now
                self._attend()
                if self._stopping:
                    return
                continue
            while not self._stopping and (wait_s := playback.wait_s(item)) > 0.0:
                self._attend()
                time.sleep(min(wait_s, _POLL_S))
            if self._stopping:
                return
            self._attend()
            started = time.perf_counter()
            self.node.check_output(item.topic, item.message)
            publication = self._publications[item.topic]
            if playback.is_past(item) and publication.row.delivery != "latched":
                continue
            publication.put(item.message)
            self._steps_ms.append((time.perf_counter() - started) * 1e3)
            playback.sent(item)

    def _wait_for_consumers(self, bus: Bus) -> None:
        deadline = time.monotonic() + self.settings.wait_s
        missing = self.settings.wait_for
        while missing and not self._stopping:
            missing = self.settings.wait_for - bus.alive_nodes()
            if missing and time.monotonic() > deadline:
                log.warning("starting without %s: not active after %g s", ", ".join(sorted(missing)),
                            self.settings.wait_s)  # fmt: skip
                break
            if missing:
                self._detail = f"waiting for {', '.join(sorted(missing))}"
                time.sleep(0.1)
        self._detail = ""

    def _attend(self) -> None:
        """What comes besides messages."""
        while self._healths:
            self.node.on_health(self._healths.popleft())
        while self._queries:
            name, query = self._queries.popleft()
            parameters = dict(query.parameters)
            reply(query, getattr(self.node, f"on_query_{name}")(parameters))

    # --- called from threads of the bus ---

    def _on_letter(self, letter: Letter) -> None:
        with self._changed:
            if self.mailbox.put(letter):
                self._changed.notify()

    def _on_undecodable(self, topic: str, reason: str) -> None:
        with self._changed:
            self.mailbox.counts[topic].undecodable += 1
            count = self._complaints.due(topic)
        if count is None:
            return
        log.warning("dropped a message on %s (%d more since the last report): %s", topic, count, reason)

    def _on_end(self, topic: str, instance: str, epoch: int, sent: int) -> None:
        with self._changed:
            self._ends.append((topic, instance, epoch, sent, time.monotonic() + _END_PATIENCE_S))
            self._changed.notify()

    def _on_query(self, name: str, query: zenoh.Query) -> None:
        self._queries.append((name, query))
        self._wake()

    def _on_health(self, health: Health) -> None:
        self._healths.append(health)
        self._wake()

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify()

    # --- health ---

    def _report(self, bus: Bus) -> None:
        while self._state != "closed":
            try:
                self._send_health(bus)
            except zenoh.ZError:  # the session is closing
                return
            time.sleep(1.0)

    def _send_health(self, bus: Bus) -> None:
        with self._changed:
            inputs = self.mailbox.health()
        steps = np.array(self._steps_ms or [0.0])
        outputs = tuple(
            OutputHealth(topic=name, sent=p.sent, bytes=p.bytes) for name, p in self._publications.items()
        )
        bus.report(
            Health(
                stamp_ns=time.time_ns(), node=self.node.name, instance=self.instance, epoch=bus.epoch,
                state=self._state, inputs=inputs, outputs=outputs,
                step_p50_ms=float(np.percentile(steps, 50)), step_p95_ms=float(np.percentile(steps, 95)),
                rss_mb=self._process.memory_info().rss / 1e6, cpu_percent=self._process.cpu_percent(),
                detail=self._detail or self.node.detail[:_DETAIL_CHARS],
            )
        )  # fmt: skip
