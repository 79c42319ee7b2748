"""Replacement of a node while the system runs: a successor starts in standby, then takes over."""

from __future__ import annotations

import json
import threading
import time
from concurrent.futures import Future, wait

import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.zenoh.queries import command
from beamsplat.tools.system.supervisor import Successor, Supervisor

READY_S = 120.0  # limit for loading a model until the first message
_WARM_S = 10.0  # limit for catching up with the predecessor, which may be faster
_BEHIND_NS = 100_000_000
_STEP_S = 20.0  # limit for the current step of the predecessor
_RESUME_S = 120.0  # limit for loading the saved state in the successor


class Swap:
    """Replacement of one node by its successor; call `poll` until it returns a text.

    If the replacement fails before the predecessor has retired, the node continues unchanged.
    """

    def __init__(self, session: zenoh.Session, supervisor: Supervisor, successor: Successor) -> None:
        self._session, self._supervisor, self.successor = session, supervisor, successor
        self._robot = supervisor.deployment.robot
        self._started = time.monotonic()
        self._configured: float | None = None
        self._retired = (0.0, 0.0)  # (retirement requested, retired), monotonic clock, s
        self._activation: Future[str] | None = None

    def poll(self) -> str | None:
        """Continue the replacement; return its result as one sentence when it is complete, else None.

        Raises:
            UserError: the replacement failed.
        """
        successor, now = self.successor, time.monotonic()
        if self._activation is not None:
            return self._taken_over()
        if successor.process is None:
            self._supervisor.restart_with(successor)
            return f"{successor.name} is stopped, and starts again with the new options"
        try:
            if not successor.process.is_alive():
                why = self._supervisor.last_error(successor.name)
                raise UserError(f"{successor.name} continues unchanged: its successor ended: {why}")
            if now - self._started > READY_S:
                raise UserError(f"{successor.name} continues unchanged: no successor after {READY_S:g} s")
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
        """Return the newest stamp in ns, by topic, that a process has published or held back in standby.

        None if the process does not answer. `instance` is the instance id of the process.
        """
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
        # The swap cannot be undone from here: a successor that fails now is restarted, as after a crash.
        self._supervisor.replace(self.successor)
        self._activation = Future()
        # In a thread: loading the saved state may take long, and the supervisor must not wait.
        threading.Thread(target=self._activate, args=(said, self._activation), daemon=True).start()
        if not self.successor.hands_over:
            wait([self._activation])
        return self._taken_over()

    def _activate(self, said: str, activation: Future[str]) -> None:
        who = (self._session, self._robot, self.successor.instance)
        try:
            activation.set_result(command(*who, "activate", {"after": said}, _RESUME_S))
        except Exception as error:  # raised again by result()
            activation.set_exception(error)

    def _taken_over(self) -> str | None:
        assert self._activation is not None  # set before the first call
        if not self._activation.done():
            return None
        try:
            came = json.loads(self._activation.result())
        except UserError:
            if self.successor.process is not None:
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
