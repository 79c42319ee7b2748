"""Publish the health of nodes that cannot run: their own processes have ended."""

from __future__ import annotations

import time

import zenoh

from beamsplat.common.messages import Health
from beamsplat.common.messages.header import local_clock_id
from beamsplat.common.messages.instances import ProcessId
from beamsplat.common.security.logins import SUPERVISOR
from beamsplat.common.topics import HEALTH, Topic
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.streams import Producer, Publication
from beamsplat.tools.system.supervisor import Supervisor

_EVERY_S = 1.0  # as nodes report their own health
_DETAIL_CHARS = 2000


class FailureReports:
    """Publisher of a health message per second with state `failed` and the reason, for each failed node.

    It also declares a liveliness token for each, so that sources do not wait for a node that cannot run.
    """

    def __init__(self, session: zenoh.Session, robot: str, supervisor: Supervisor) -> None:
        self._session, self._robot, self._supervisor = session, robot, supervisor
        self._publications: dict[str, Publication] = {}
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._due_s = 0.0

    def poll(self) -> None:
        """Publish what is due; call it several times per second."""
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = now_s + _EVERY_S
        for entry in self._supervisor.children.values():
            if entry.failed and entry.name not in self._tokens:
                key_expr = key(self._robot, "failed", entry.name, entry.instance)
                self._tokens[entry.name] = self._session.liveliness().declare_token(key_expr)
            elif not entry.failed and entry.name in self._tokens:
                self._tokens.pop(entry.name).undeclare()
            if entry.failed and not entry.process.is_alive():
                self._publish(entry.identity, entry.failed)

    def _publish(self, identity: ProcessId, why: str) -> None:
        name, epoch, instance = identity
        if name not in self._publications:
            self._publications[name] = Publication(
                self._session, Producer(SUPERVISOR, instance, epoch, local_clock_id()),
                Topic(HEALTH, Health, (SUPERVISOR,), 1, "latest"), key(self._robot, HEALTH, name),
            )  # fmt: skip
        self._publications[name].put(
            Health(
                stamp_ns=time.time_ns(), node=name, instance=instance, epoch=epoch, state="failed",
                detail=why[:_DETAIL_CHARS], clock_id=local_clock_id(),
            )
        )  # fmt: skip
