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
from functools import partial
from typing import Any

import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import Bookmark, claim_epoch
from beamsplat.common.messages import Health
from beamsplat.common.messages.header import local_clock_id
from beamsplat.common.runtime.control import Control
from beamsplat.common.runtime.handover import CONTROL, Takeover
from beamsplat.common.runtime.health_reporter import Vitals
from beamsplat.common.runtime.jobs import Abandoned, JobQueue, Worker
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.mailbox import NOBODY, Letter, Mailbox
from beamsplat.common.runtime.node import Job, Node, Output
from beamsplat.common.runtime.pacing import Playback, wait_for_nodes
from beamsplat.common.runtime.rate_limited_log import Complaints
from beamsplat.common.security.logins import login_of
from beamsplat.common.zenoh.bus import Bus, open_session
from beamsplat.common.zenoh.queries import ask, reply
from beamsplat.common.zenoh.streams import Publication

log = logging.getLogger(__name__)

_POLL_S = 0.2  # how soon a signal is noticed while nothing arrives
_STOP_PATIENCE_S = 2.0  # after a signal, background jobs have so long to finish
_END_PATIENCE_S = 5.0  # an end marker waits this long for messages still on their way
_SILENCE_S = 1.0


class Live:
    """Runs one node until its inputs end or a signal comes."""

    def __init__(self, node: Node, settings: LiveSettings) -> None:
        self.node = node
        self.settings = node.home = settings
        self.instance = settings.instance or secrets.token_hex(8)
        self.takeover = Takeover(settings.standby)
        self.greets = True  # letters, when they arrive
        self.greeting = threading.Lock()  # held for one: whoever retires ends none in the middle
        self.mailbox = Mailbox(type(node), time.monotonic_ns)
        self.changed = threading.Condition()
        self._stopping = False
        self._stop_by = math.inf
        self.state = "configure"
        self.detail = ""
        self._queries: deque[tuple[str, zenoh.Query]] = deque()
        self._healths: deque[Health] = deque(maxlen=256)
        self._ends: list[tuple[str, str, int, int, float]] = []
        self.steps_ms: deque[float] = deque(maxlen=512)
        self.publications: dict[str, Publication] = {}
        self._complaints = Complaints()
        self._bookmark = Bookmark(settings.run_dir, node.name)
        self._clock_id = local_clock_id()

    def run(self) -> None:
        """Life of the process: configure, standby, active, drain, drained, closed."""
        epoch = claim_epoch(self.settings.run_dir, self.node.name)
        if not self.settings.resume:  # an earlier run's: a crash before the first message must not lead there
            self._bookmark.clear()
        try:
            login = login_of(self.settings.security, self.node.name)
            session = open_session(self.settings.endpoints, gave_up=lambda: self._stopping, login=login)
        except UserError:
            if self._stopping:
                return
            raise
        with Bus(session, self.settings.robot, self.node.name, self.instance, epoch) as bus:
            vitals = Vitals(self, bus)
            self._jobs = JobQueue(Worker(self._gave_up).submit)
            self.node.meet(partial(ask, session, self.settings.robot))
            try:
                self.node.configure()
                self.state = "standby"
                self._control = Control(self, bus)
                self._join(bus)
                self._work(bus)
                vitals.send()
            except Abandoned:
                log.warning("stopped in the middle of a background job: its result is lost")
            finally:
                self.state = "closed"
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
        self.publications = {name: bus.publish(name) for name in self.node.outputs}
        for entry in self.node.inputs:
            if entry.topic in self.settings.unfed:
                self.mailbox.end(entry.topic, NOBODY, 0)
            bus.subscribe(entry, self._on_letter, self._on_undecodable, self._on_end)
        if self.node.watches_health():
            bus.watch_health(self._on_health)
        bus.obey(self._on_query)
        if not self.takeover.standby:
            self.show(bus)

    def show(self, bus: Bus) -> None:
        """From now on this instance is the node."""
        for name in self.node.queries():
            bus.answer(name, self._on_query)
        bus.declare_alive()

    def _work(self, bus: Bus) -> None:
        if self.node.is_source():
            self._wait_for_consumers(bus)
            self.state = "active"
            self._run_source()
        else:
            if not self.takeover.standby:
                self.state = "active"
            self._run_steps()
        if self.takeover.retired or self.takeover.standby:
            return
        finished = not self._stopping
        self.state = "drain"
        self.finish_jobs()
        self.emit(self.node.handle_drain())
        self.state = "drained"
        if finished:  # stopped by a signal it leaves the stream open: a successor goes on
            self._bookmark.finish()
            for publication in self.publications.values():
                bus.end(publication)
            while not (self._stopping or self.settings.exit_when_drained or self.takeover.retired):
                self._attend()
                self._hear_answers()
                with self.changed:
                    self.changed.wait(_POLL_S)

    def _hear_answers(self) -> None:
        """What is fed back to a node that has ended is still heard; it has nothing more to say to it."""
        while (letter := self._next()) is not None:
            self.node.on_header(letter.header)
            for _ in self.node.handle(letter.topic, letter.message):
                pass

    # --- the node's own thread ---

    def _run_steps(self) -> None:
        heard = time.monotonic()
        while not self._stopping:
            self._attend()
            if self.takeover.retired:
                return
            if self.takeover.standby and self.node.hands_over:
                with self.changed:  # letters wait until it knows what its predecessor knew
                    self.changed.wait(_POLL_S)
                continue
            letter = self._next()
            self._emit_all(self._jobs.finished())
            if letter is None:
                if self.mailbox.ended:
                    if not (self.mailbox.answers_may_come and self.node.awaits_answers()):
                        return
                    heard = self._tell_of_silence(heard)
                continue
            heard = time.monotonic()
            if self.takeover.was_handled(letter):
                continue
            started = time.perf_counter()
            self._emit_all(self._jobs.before_message(letter.topic))
            self.node.on_header(letter.header)
            self.emit(self.node.handle(letter.topic, letter.message))
            self.steps_ms.append((time.perf_counter() - started) * 1e3)

    def _tell_of_silence(self, heard: float) -> float:
        silence_s = time.monotonic() - heard
        if silence_s < _SILENCE_S:
            time.sleep(0.02)  # `_next` does not wait once the inputs have ended
            return heard
        self.emit(self.node.handle_silence(silence_s))
        return heard + silence_s

    def _next(self) -> Letter | None:
        """The next letter, or None after a short wait."""
        with self.changed:
            self._apply_ends()
            letter = self.mailbox.pop()
            if letter is None and not self.mailbox.ended:
                self.changed.wait(_POLL_S)
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

    def finish_jobs(self) -> None:
        """Waits for the background jobs and takes in what they bring."""
        self._emit_all(self._jobs.rest())

    def _emit_all(self, results: Iterator[tuple[str, Any]]) -> None:
        for name, result in results:
            self.emit(self.node.handle_job(name, result))

    def emit(self, outputs: Iterator[Output]) -> None:
        for output in outputs:
            if isinstance(output, Job):
                self._jobs.start(output).add_done_callback(lambda _: self._wake())
            elif not self.takeover.keeps(*output):
                self.publications[output[0]].put(output[1])

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
            publication = self.publications[item.topic]
            if playback.is_past(item) and publication.row.delivery != "latched":
                continue
            publication.put(item.message)
            self.steps_ms.append((time.perf_counter() - started) * 1e3)
            playback.sent(item)

    def _wait_for_consumers(self, bus: Bus) -> None:
        def say(missing: list[str]) -> None:
            self.detail = f"waiting for {', '.join(missing)}"

        wait_for_nodes(bus.alive_nodes, self.settings, lambda: self._stopping, say)
        self.detail = ""

    def _attend(self) -> None:
        """What comes besides messages."""
        while self._healths:
            self.node.on_health(self._healths.popleft())
        while self._queries:
            name, query = self._queries.popleft()
            parameters = dict(query.parameters)
            if name.startswith(CONTROL):
                reply(query, self._control.obey(name.removeprefix(CONTROL + "/"), parameters))
                continue
            reply(query, getattr(self.node, f"on_query_{name}")(parameters))

    # --- called from threads of the bus ---

    def _on_letter(self, letter: Letter) -> None:
        with self.greeting:
            # What a predecessor has dealt with comes again from the sender's cache, perhaps late.
            over = self.takeover.standby or self.takeover.retired or self.takeover.was_handled(letter)
            if self.greets and not over:
                self.emit(self.node.handle_arrival(letter.topic, letter.message))
        with self.changed:
            if self.mailbox.put(letter):
                self.changed.notify()

    def _on_undecodable(self, topic: str, reason: str) -> None:
        with self.changed:
            self.mailbox.counts[topic].undecodable += 1
            count = self._complaints.due(topic)
        if count is not None:
            log.warning("dropped a message on %s (%d more since the last report): %s", topic, count, reason)

    def _on_end(self, topic: str, instance: str, epoch: int, sent: int) -> None:
        with self.changed:
            self._ends.append((topic, instance, epoch, sent, time.monotonic() + _END_PATIENCE_S))
            self.changed.notify()

    def _on_query(self, name: str, query: zenoh.Query) -> None:
        self._queries.append((name, query))
        self._wake()

    def _on_health(self, health: Health) -> None:
        self._healths.append(health)
        self._wake()

    def _wake(self) -> None:
        with self.changed:
            self.changed.notify()
