"""The inbox of a mapper: keyframes are written to disk on reception, before they are processed.

A mapper may be minutes behind a robot that reconnects after an outage. Keyframes in the inbox are
acknowledged at once, so the robot may delete them; if the mapper is killed, the next process reads them from
the session.
"""

from __future__ import annotations

from collections.abc import Callable

from beamsplat.services.mapping.session.checkpointer import Checkpointer


class Inbox:
    """Keyframes that were received but not processed yet; all of them are on disk.

    `accept` runs on the receiving thread, all other methods on the mapping thread. The mailbox of the node is
    smaller than the inbox and drops its oldest messages. Keyframes dropped there are *skipped*: they are read
    back from the disk later. So are keyframes that an earlier process has left there.
    """

    def __init__(self, checkpointer: Checkpointer) -> None:
        self._checkpointer = checkpointer
        self._waiting: dict[int, None] = {}  # in order of arrival
        self._skipped: dict[int, None] = {}  # oldest first
        self._read: int | None = None  # read from the disk, and being processed now

    def accept(self, id: int, known: bool, body: Callable[[], tuple[str, bytes]]) -> bool:
        """Write a received keyframe to disk, unless it is on disk already; return whether it is on disk now.

        Args:
            known: True if the keyframe is already in the map.
            body: returns schema and payload of the keyframe.
        """
        if known:
            return not self._checkpointer.is_unwritten(id)
        if id not in self._waiting and id not in self._skipped:
            if not self._checkpointer.write_keyframe(id, *body()):
                return False
            self._waiting[id] = None
        return True

    def start(self, id: int) -> bool:
        """Take a keyframe out of the inbox for processing; return whether it is on disk.

        Keyframes that arrived before it and still wait were dropped by the mailbox: they become skipped.
        """
        if id in self._skipped:  # left by an earlier process, and also in this one's mailbox
            del self._skipped[id]
            return True
        if id not in self._waiting:
            return id == self._read
        for other in list(self._waiting):
            del self._waiting[other]
            if other == id:
                return True
            self._skipped[other] = None
        return True

    def __len__(self) -> int:
        """Return the number of waiting keyframes, including skipped keyframes."""
        return len(self._waiting) + len(self._skipped)

    @property
    def has_skipped(self) -> bool:
        """Return whether there are skipped keyframes."""
        return bool(self._skipped)

    def pop_skipped(self) -> int | None:
        """Remove and return the id of the oldest skipped keyframe; None without any."""
        if not self._skipped:
            return None
        self._read = next(iter(self._skipped))
        del self._skipped[self._read]
        return self._read

    def skip(self, ids: list[int]) -> None:
        """Add keyframes on disk that an earlier process has not processed, oldest first."""
        self._skipped.update(dict.fromkeys(ids))

    def skip_waiting(self) -> None:
        """Mark all waiting keyframes as skipped: after the end of the stream, the mailbox is empty."""
        self._skipped.update(self._waiting)
        self._waiting.clear()
