"""Requests to a supervisor from the bus: `query/<node>/restart`, for the nodes that are its own."""

from __future__ import annotations

import time
from collections.abc import Iterator

import zenoh

from common.bus import key
from common.messages import Answer
from common.queries import reply
from services.supervisor import Supervisor


class Commands:
    """The requests that have come; `attend()` a few times a second, beside `Supervisor.poll()`."""

    def __init__(self, session: zenoh.Session, robot: str, supervisor: Supervisor) -> None:
        self._supervisor = supervisor
        self._queryable = session.declare_queryable(
            key(robot, "query", "*", "restart"), zenoh.handlers.FifoChannel(16)
        )

    def attend(self) -> None:
        """Does what was asked for since the last time."""
        while (query := self._queryable.try_recv()) is not None:
            node = str(query.key_expr).split("/")[-2]
            if node in self._supervisor.children:
                reply(query, self._restart(node))
            else:  # another host's: its supervisor answers
                query.drop()

    def _restart(self, node: str) -> Iterator[Answer]:
        self._supervisor.restart(node)
        yield Answer(stamp_ns=time.time_ns(), text=f"{node} was told to end, and starts again")
