"""Answers the supervisor's hand-over requests to one process, between two steps of its node."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator

from beamsplat.common.messages import Answer
from beamsplat.common.runtime.handover import parse_progress
from beamsplat.common.runtime.running_node import RunningNode
from beamsplat.common.zenoh.bus import Bus

log = logging.getLogger(__name__)


class HandoverControl:
    """Answers the requests `reached`, `retire` and `activate` to one process (see `runtime.handover`)."""

    def __init__(self, running: RunningNode, bus: Bus) -> None:
        self._running, self._bus = running, bus

    def answer(self, verb: str, parameters: dict[str, str]) -> Iterator[Answer]:
        """Carry out the request `verb` and yield its answer: one message with text.

        Raises:
            ValueError: the request is unknown, not possible now, or failed; the process remains in its
                state (standby, active or retired).
        """
        handover = self._running.handover
        if verb == "reached":
            text = handover.reached()
        elif verb == "retire":
            text = self._retire()
        elif verb == "activate" and handover.standby:
            text = self._activate(parameters.get("after", "{}"))
        else:
            raise ValueError(f"{self._running.node.name} cannot answer the request {verb!r} now")
        yield Answer(stamp_ns=time.time_ns(), text=text)

    def _retire(self) -> str:
        r = self._running
        if not r.node.hands_over:
            return r.handover.retire()
        if not r.handover.retired:
            r.finish_jobs()
            with r.arrival_lock:
                r.handover.retired = True  # messages that arrive from here on belong to the successor
            try:
                r.node.hand_over()
            except Exception:
                r.handover.retired = False
                raise
        with r.arrival_lock, r.changed:
            return r.handover.retire(r.mailbox.handled())

    def _pass_on_arrivals(self) -> None:
        """Call `on_arrival` for the messages received in standby, before newer messages are received."""
        r, passed = self._running, set()
        while not r.accepts_arrivals:
            with r.arrival_lock, r.changed:
                new = [w for w in r.mailbox.queued() if id(w) not in passed]
                r.accepts_arrivals = not new
            for envelope in new:
                passed.add(id(envelope))
                if not r.handover.was_handled(envelope):
                    r.emit(r.node.handle_arrival(envelope.topic, envelope.message))

    def _activate(self, after: str) -> str:
        r = self._running
        progress = parse_progress(after)
        if r.node.hands_over:
            r.node.take_over()
        r.accepts_arrivals = not r.node.hands_over  # queued messages are passed on first
        held = list(r.handover.activate(progress))
        self._pass_on_arrivals()
        r.emit(iter(held))
        self._bus.announce(r.node.queries())
        r.state = "active"
        lost = r.handover.lost
        if lost:
            log.warning("%d messages were lost in the hand-over: neither process published them", lost)
        return json.dumps({"kept": len(held), "lost": lost})
