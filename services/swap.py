"""Swapping a node while the system runs: a successor in standby, then one moment in which it takes over."""

from __future__ import annotations

import json
import time

import zenoh

from common.errors import UserError
from common.queries import command
from services.supervisor import Successor, Supervisor, last_line

READY_S = 120.0  # to load a model, and say something
_WARM_S = 10.0  # to catch up with its predecessor, which may be the faster
_BEHIND_NS = 100_000_000
_STEP_S = 20.0  # of the predecessor, between two messages


class Swap:
    """One swap under way; `poll()` until it gives a sentence. If it fails, the node goes on as it was."""

    def __init__(self, session: zenoh.Session, supervisor: Supervisor, successor: Successor) -> None:
        self._session, self._supervisor, self.successor = session, supervisor, successor
        self._robot = supervisor.deployment.robot
        self._started = time.monotonic()
        self._configured: float | None = None

    def poll(self) -> str | None:
        """What has come of it, once something has.

        Raises:
            UserError: nothing was changed, and why.
        """
        successor, now = self.successor, time.monotonic()
        if successor.process is None:
            self._supervisor.restart_with(successor)
            return f"{successor.name} was told to end, and starts again with the new options"
        try:
            if not successor.process.is_alive():
                log = self._supervisor.log_file(successor.name)
                raise UserError(f"{successor.name} goes on as it was: its successor ended: {last_line(log)}")
            if now - self._started > READY_S:
                raise UserError(f"{successor.name} goes on as it was: no successor after {READY_S:g} s")
            reached = self._reached(successor.instance)
            if reached is None:
                return None
            self._configured = self._configured or now
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

    def _take_over(self) -> str:
        name = self.successor.name
        started = time.monotonic()
        before = self._supervisor.children[name]
        said = command(self._session, self._robot, before.instance, "retire", {}, _STEP_S)
        retired = time.monotonic()
        # From here on there is no way back: a successor that fails now is started again, as after a crash.
        self._supervisor.replace(self.successor)
        kept = command(
            self._session, self._robot, self.successor.instance, "activate", {"after": said}, _STEP_S
        )
        return (
            f"{name} was taken over {time.monotonic() - self._started:.1f} s after it was asked for: its "
            f"predecessor ended its last message in {(retired - started) * 1e3:.0f} ms, its successor began "
            f"{(time.monotonic() - retired) * 1e3:.0f} ms later with {kept} messages kept back"
        )
