"""Replacement of a node while the system runs: a successor starts in standby, then takes over."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Generator
from concurrent.futures import Future, wait
from typing import Any

import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.zenoh.queries import NoQueryAnswer, command
from beamsplat.tools.system.supervisor import Successor, Supervisor

log = logging.getLogger("beamsplat")

READY_S = 120.0  # limit for loading a model until the first message
_WARM_S = 10.0  # limit for catching up with the predecessor, which may be faster
_BEHIND_NS = 100_000_000
_STEP_S = 20.0  # limit for the current step of the predecessor
_RESUME_S = 120.0  # limit for loading the saved state in the successor
_WAIT_S = 0.05  # longest wait of `poll` for an answer: most come at once

# A request in progress, or None to pause until the next `poll`; receives the answer.
_Steps = Generator[Future[str] | None, str, Any]


class Swap:
    """Replacement of one node by its successor; call `poll` until it returns a text.

    Requests to the two processes are sent in threads, so that `poll` never waits for a long step of a node.
    If the replacement fails before the predecessor has retired, the node continues unchanged.
    """

    def __init__(self, session: zenoh.Session, supervisor: Supervisor, successor: Successor) -> None:
        self._session, self._supervisor, self.successor = session, supervisor, successor
        self._robot = supervisor.deployment.robot
        self._started = time.monotonic()
        self._steps = self._replace()
        self._request: Future[str] | None = None

    def poll(self) -> str | None:
        """Continue the replacement; return its result as one sentence when it is complete, else None.

        Raises:
            UserError: the replacement failed.
        """
        try:
            if self._request is None:
                self._request = next(self._steps)
            while self._request is not None and wait([self._request], _WAIT_S).done:
                error = self._request.exception()
                self._request = (
                    self._steps.throw(error) if error else self._steps.send(self._request.result())
                )
        except StopIteration as end:
            return end.value
        except UserError as error:
            self._supervisor.discard(self.successor)
            raise UserError(f"{self.successor.name} was not swapped: {error}") from error
        return None

    def _replace(self) -> _Steps:
        """Carry out the replacement; return the text that describes it."""
        successor, supervisor, name = self.successor, self._supervisor, self.successor.name
        if successor.process is None:
            supervisor.restart_with(successor)
            return f"{name} is stopped, and starts again with the new options"
        yield from self._until_ready()
        before = supervisor.children[name]
        assert successor.identity is not None  # it runs
        if before.identity.epoch > successor.identity.epoch:
            # Subscribers would take the successor for an earlier process than the running one.
            raise UserError(f"{name} continues unchanged: it was started again while its successor started")
        asked = time.monotonic()
        before.retiring = True
        try:
            said = yield self._ask(before.instance, "retire", {}, _STEP_S)
            _table("retire", said)
        except UserError:
            before.retiring = False
            raise
        retired = time.monotonic()
        # The swap cannot be undone from here: a successor that fails now is restarted, as after a crash.
        supervisor.replace(successor)
        came = _table(
            "activate", (yield self._ask(successor.instance, "activate", {"after": said}, _RESUME_S))
        )
        lost = f", {came['lost']} more are lost" if came.get("lost") else ""
        return (
            f"{name} was taken over {time.monotonic() - self._started:.1f} s after it was "
            f"asked for: its predecessor ended its last message in {(retired - asked) * 1e3:.0f} ms, its "
            f"successor began {(time.monotonic() - retired) * 1e3:.0f} ms later with {came.get('kept', 0)} "
            f"messages kept back{lost}"
        )

    def _until_ready(self) -> _Steps:
        """Wait until the successor answers and has caught up with its predecessor, as far as it can."""
        successor, supervisor = self.successor, self._supervisor
        assert successor.process is not None  # else there is nothing to wait for
        configured: float | None = None
        while True:
            if not successor.process.is_alive():
                why = supervisor.last_error(successor.name)
                raise UserError(f"{successor.name} continues unchanged: its successor ended: {why}")
            if time.monotonic() - self._started > READY_S:
                raise UserError(f"{successor.name} continues unchanged: no successor after {READY_S:g} s")
            reached = yield from self._reached(successor.instance)
            if reached is not None:
                configured = configured or time.monotonic()
                if successor.hands_over or time.monotonic() - configured >= _WARM_S:
                    return
                before = yield from self._reached(supervisor.children[successor.name].instance)
                if all(
                    stamp - reached.get(topic, 0) <= _BEHIND_NS for topic, stamp in (before or {}).items()
                ):
                    return
            yield None

    def _reached(self, instance: str) -> _Steps:
        """Return the newest stamp in ns, by topic, that a process has published or held back in standby.

        None if the process does not answer. `instance` is the instance id of the process.
        """
        try:
            said = yield self._ask(instance, "reached", {}, 0.5)
        except NoQueryAnswer:
            return None
        stamps = _table("reached", said)
        if not all(isinstance(stamp_ns, int) for stamp_ns in stamps.values()):
            raise UserError(f"a process answered reached with {said[:80]!r}, expected stamps in ns")
        return stamps

    def _ask(self, instance: str, verb: str, parameters: dict[str, str], timeout_s: float) -> Future[str]:
        """Send a request to one process, in a thread of its own; all faults of the answer are UserErrors."""
        answer: Future[str] = Future()

        process = self.successor.name, instance

        def ask() -> None:
            try:
                answer.set_result(command(self._session, self._robot, process, verb, parameters, timeout_s))
            except UserError as error:
                answer.set_exception(error)
            except Exception as error:  # whatever a process sends, the supervisor goes on
                log.exception("%s: the request %s failed", self.successor.name, verb)
                answer.set_exception(UserError(f"{self.successor.name}: the request {verb} failed: {error}"))

        threading.Thread(target=ask, name=f"swap-{verb}", daemon=True).start()
        return answer


def _table(verb: str, text: str) -> dict[str, Any]:
    """Return the JSON object that a process has answered.

    Raises:
        UserError: the text is something else.
    """
    try:
        table = json.loads(text)
    except (ValueError, RecursionError):
        table = None
    if not isinstance(table, dict):
        raise UserError(f"a process answered {verb} with {text[:80]!r}, expected a JSON object")
    return table
