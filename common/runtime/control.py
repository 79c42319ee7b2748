"""What a supervisor asks of one process during a swap (common/takeover.py), answered between two steps."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

from beamsplat.common.files.persist import claim_epoch
from beamsplat.common.messages import Answer
from beamsplat.common.zenoh.bus import Bus

if TYPE_CHECKING:
    from beamsplat.common.runtime.live import Live

log = logging.getLogger(__name__)


class Control:
    """The three requests, by verb."""

    def __init__(self, live: Live, bus: Bus) -> None:
        self._live, self._bus = live, bus

    def obey(self, verb: str, parameters: dict[str, str]) -> Iterator[Answer]:
        """Does what is asked.

        Raises:
            ValueError: no such request, not now, or it fails: what the process is stays as it was.
        """
        takeover = self._live.takeover
        if verb == "reached":
            text = takeover.reached()
        elif verb == "retire":
            text = self._retire()
        elif verb == "activate" and takeover.standby:
            text = self._activate(parameters.get("after", "{}"))
        else:
            raise ValueError(f"nothing called {verb!r} can be asked of {self._live.node.name} now")
        yield Answer(stamp_ns=time.time_ns(), text=text)

    def _retire(self) -> str:
        live = self._live
        if not live.node.hands_over:
            return live.takeover.retire()
        if not live.takeover.retired:
            live.finish_jobs()
            with live.greeting:
                live.takeover.retired = True  # what arrives from here on is the successor's
            try:
                live.node.hand_over()
            except ValueError:
                live.takeover.retired = False
                raise
        with live.changed:
            return live.takeover.retire(live.mailbox.handled())

    def _greet_waiting(self) -> None:
        """Letters that came in standby arrive now, for the node, and before those that come from now on."""
        live, greeted = self._live, set()
        while not live.greets:
            with live.changed:
                news = [w for w in live.mailbox.waiting() if id(w) not in greeted]
                live.greets = not news
            for letter in news:
                greeted.add(id(letter))
                if not live.takeover.was_handled(letter):
                    live.emit(live.node.handle_arrival(letter.topic, letter.message))

    def _activate(self, after: str) -> str:
        live = self._live
        if live.node.hands_over:
            live.node.take_over()
        live.greets = not live.node.hands_over  # who came first is greeted first
        held = list(live.takeover.activate(after))
        self._bus.epoch = claim_epoch(live.settings.run_dir, live.node.name)
        self._greet_waiting()
        live.emit(iter(held))
        live.show(self._bus)
        live.state = "active"
        lost = live.takeover.lost
        if lost:
            log.warning("%d messages that nobody has said were not kept back in standby: lost", lost)
        return json.dumps({"kept": len(held), "lost": lost})
