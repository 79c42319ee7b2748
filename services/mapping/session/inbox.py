"""Keyframes between their arrival and their turn: on the disk at once, so that their sender may forget them.

A mapper may be a minute behind a robot that comes back from an outage. What has arrived is safe meanwhile: a
mapper that is killed finds it in its session.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from beamsplat.services.mapping.session.checkpointer import Keeper


class Arrivals:
    """`take` is called by the thread that receives, everything else by the one that maps."""

    def __init__(self, keeper: Keeper) -> None:
        self._keeper = keeper
        self._waiting: dict[int, None] = {}  # in order of arrival
        self._overtaken: deque[int] = deque()
        self._read: int | None = None  # came from the disk, and has its turn now

    def take(self, id: int, known: bool, body: Callable[[], tuple[str, bytes]]) -> bool:
        """Whether a keyframe that has just come is on the disk. `known`: the mapper has it already; `body`
        gives its schema and payload."""
        if known:
            return not self._keeper.lacks(id)
        if id not in self._waiting and id not in self._overtaken:
            if not self._keeper.keep(id, *body()):
                return False
            self._waiting[id] = None
        return True

    def begin(self, id: int) -> bool:
        """A keyframe's turn has come; whether it was on the disk already. Those that came before it and had
        no turn never will: more were waiting than a mailbox holds."""
        if id not in self._waiting:
            return id == self._read
        for other in list(self._waiting):
            del self._waiting[other]
            if other == id:
                return True
            self._overtaken.append(other)
        return True

    def __len__(self) -> int:
        """How many wait."""
        return len(self._waiting) + len(self._overtaken)

    @property
    def behind(self) -> bool:
        """Some will have no turn."""
        return bool(self._overtaken)

    def overtaken(self) -> tuple[str, bytes] | None:
        """(schema, payload) of the oldest that will have no turn; None if there is none that can be read."""
        while self._overtaken:
            self._read = self._overtaken.popleft()
            body = self._keeper.body(self._read)
            if body is not None:
                return body
        return None

    def rest(self) -> None:
        """Nothing more comes: what waits still will have no turn."""
        self._overtaken.extend(self._waiting)
        self._waiting.clear()
