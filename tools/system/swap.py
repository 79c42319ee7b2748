"""Swapping a node while the system runs: a successor in standby, then one moment in which it takes over."""

from __future__ import annotations

import json
import threading
import time
from concurrent.futures import Future, wait

import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.zenoh.queries import command
from beamsplat.tools.system.supervisor import Successor, Supervisor

READY_S = 120.0  # to load a model, and say something
_WARM_S = 10.0  # to catch up with its predecessor, which may be the faster
_BEHIND_NS = 100_000_000
_STEP_S = 20.0  # of the predecessor, between two messages
_RESUME_S = 120.0  # of the successor, to take up what was left to it


class Swap:
    """One swap under way; `poll()` until it gives a sentence. If it fails, the node goes on as it was."""

    def __init__(self, session: zenoh.Session, supervisor: Supervisor, successor: Successor) -> None:
        self._session, self._supervisor, self.successor = session, supervisor, successor
        self._robot = supervisor.deployment.robot
        self._started = time.monotonic()
        self._configured: float | None = None
        self._retired = (0.0, 0.0)  # when it was asked to, when it had
        self._activation: Future[str] | None = None

    def poll(self) -> str | None:
        """What has come of it, once something has.

        Raises:
            UserError: nothing was changed, and why.
        """
        successor, now = self.successor, time.monotonic()
        if self._activation is not None:
            return self._taken_over()
        if successor.process is None:
            self._supervisor.restart_with(successor)
            return f"{successor.name} was told to end, and starts again with the new options"
        try:
            if not successor.process.is_alive():
                why = self._supervisor.last_error(successor.name)
                raise UserError(f"{successor.name} goes on as it was: its successor ended: {why}")
            if now - self._started > READY_S:
                raise UserError(f"{successor.name} goes on as it was: no successor after {READY_S:g} s")
            reached = self._reached(successor.instance)
            if reached is None:
                return None
            self._configured = self._configured or now
            if successor.hands_over:
                return self._take_over()
            before = self._reached(self._supervisor.children[successor.name].instance)
            behind = any(
                stamp - reached.get(topic, 0) > _BEHIND_NS for topic, stamp in (before or {}).items()
            )
            if behind and now - self._configured < _WARM_S:
                return None
            return self._take_over()
        except UserError:
            successor.process.kill()
            raise

    def _reached(self, instance: str) -> dict[str, int] | None:
        """How far a process is, by topic; None if it does not answer."""
        try:
            return json.loads(command(self._session, self._robot, instance, "reached", {}, 0.5))
        except UserError:
            return None

    def _take_over(self) -> str | None:
        name = self.successor.name
        asked = time.monotonic()
        before = self._supervisor.children[name]
        said = command(self._session, self._robot, before.instance, "retire", {}, _STEP_S)
        self._retired = (asked, time.monotonic())
        # From here on there is no way back: a successor that fails now is started again, as after a crash.
        self._supervisor.replace(self.successor)
        self._activation = Future()
        # What was left may take long to take up, and others are to be looked after meanwhile.
        threading.Thread(target=self._activate, args=(said, self._activation), daemon=True).start()
        if not self.successor.hands_over:
            wait([self._activation])
        return self._taken_over()

    def _activate(self, said: str, activation: Future[str]) -> None:
        who = (self._session, self._robot, self.successor.instance)
        try:
            activation.set_result(command(*who, "activate", {"after": said}, _RESUME_S))
        except Exception as error:  # raised where the result is asked for
            activation.set_exception(error)

    def _taken_over(self) -> str | None:
        if not self._activation.done():
            return None
        try:
            came = json.loads(self._activation.result())
        except UserError:
            self.successor.process.kill()
            raise
        asked, retired = self._retired
        lost = f", {came['lost']} more are lost" if came["lost"] else ""
        return (
            f"{self.successor.name} was taken over {time.monotonic() - self._started:.1f} s after it was "
            f"asked for: its predecessor ended its last message in {(retired - asked) * 1e3:.0f} ms, its "
            f"successor began {(time.monotonic() - retired) * 1e3:.0f} ms later with {came['kept']} messages "
            f"kept back{lost}"
        )
