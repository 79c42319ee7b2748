"""Keyframes that nobody has acknowledged: kept within a bound, on disk where there is a folder, sent again.

Every keyframe goes out once when it is made; this is about those that did not arrive. What is sent later
arrives later, so an answer to one tells that all sent before it and not answered are lost: they go out again,
oldest first, a few at a time, each answer making room for the next. Live keyframes never wait for them. While
nobody answers at all, only the oldest is tried now and then.

Beyond the bound the least useful goes: one of an earlier drive, which no mapper waits for, else the one whose
view is nearest to another that is kept.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from beamsplat.common.runtime.rate_limited_log import RateLimitedLog
from beamsplat.services.keyframes.folder import Folder, Label

log = logging.getLogger("beamsplat.keyframes")

_MEMORY_BYTES = 64_000_000  # of those that the disk would not take
_NEWEST_EVERY = 4  # sendings again


@dataclass
class _Entry:
    label: Label
    payload: bytes | None  # None = on disk
    order: int | None = None  # of its latest sending; None = to be sent
    again: bool = False  # its latest sending was not its first


class Outbox:
    """Times are those of measurements, so that a replay repeats what was sent again."""

    def __init__(self, limit_bytes: int, retry_ns: int, window: int, folder: Path | None = None) -> None:
        """`window` of those sent again are on their way at once.

        Raises:
            ValueError: a bound that is not positive.
            UserError: the folder cannot be made.
        """
        if limit_bytes < 1 or retry_ns <= 0 or window < 1:
            raise ValueError(f"bounds must be positive, got {limit_bytes} bytes, {retry_ns} ns, {window}")
        self._limit, self._retry_ns, self._window = limit_bytes, retry_ns, window
        self._folder = Folder(folder) if folder is not None else None
        self._entries: dict[int, _Entry] = {}
        self._sendings = self._caught_up = 0  # in all; of the lost ones
        self._heard_ns: int | None = None  # the last answer, or the last attempt to get one
        self._useless = 0
        self._complaints = RateLimitedLog()
        self.drive = ""  # the present one
        self.bytes = 0
        self.given_up = 0  # never acknowledged, and gone for lack of room
        self.unstored = 0  # the disk would not take them: in memory only
        if self._folder is not None:
            for label in self._folder.labels():
                self._entries[label.key] = _Entry(label, None)
                self.bytes += label.size
            self._make_room(keep=None)

    def __len__(self) -> int:
        """How many wait for an answer of the present drive's mapper."""
        return sum(entry.label.drive == self.drive for entry in self._entries.values())

    def rename(self, before: str, drive: str) -> None:
        """The present drive, which went by `before` so far, has a name that survives a restart."""
        for entry in self._entries.values():
            if entry.label.drive == before:
                entry.label = replace(entry.label, drive=drive)
        self.drive = drive

    @property
    def earlier(self) -> int:
        """How many are left of earlier drives."""
        return len(self._entries) - len(self)

    @property
    def broken(self) -> int:
        """Those that could not be read."""
        return self._useless + (self._folder.broken if self._folder is not None else 0)

    def put(self, key: int, view: np.ndarray, payload: bytes, now_ns: int) -> None:
        """Takes what is sent for the first time now. `view` [6]: place and viewing direction, each in units
        that make one of either a keyframe's worth."""
        label = Label(key, self.drive, tuple(float(value) for value in view), len(payload))
        self._forget(key)
        if not len(self):
            self._heard_ns = now_ns  # silence is counted from here
        self._entries[key] = _Entry(
            label, None if self._stored(label, payload) else payload, self._next_order()
        )
        self.bytes += label.size
        self._make_room(keep=key)

    def acknowledge(self, key: int, now_ns: int) -> bool:
        """It has arrived, so what was sent before it and is not answered has not. False if not waited for."""
        entry = self._entries.get(key)
        self._heard_ns = now_ns
        if entry is None:
            return False
        self._forget(key)
        for other in self._entries.values():
            if entry.order is not None and other.order is not None and other.order < entry.order:
                other.order = None
        return True

    def due(self, now_ns: int) -> Iterator[tuple[int, bytes]]:
        """Keys and payloads to send again now."""
        mine = [entry for entry in self._entries.values() if entry.label.drive == self.drive]
        if not mine:
            return
        if self._heard_ns is None or now_ns - self._heard_ns >= self._retry_ns:
            self._heard_ns = now_ns
            yield from self._send(min(mine, key=lambda entry: entry.label.key))
            return
        on_their_way = sum(entry.again and entry.order is not None for entry in mine)
        lost = sorted((e for e in mine if e.order is None), key=lambda entry: entry.label.key)
        for _ in range(min(self._window - on_their_way, len(lost))):
            # Now and then the newest: where the robot is now should not wait for all of an outage.
            self._caught_up += 1
            newest = self._caught_up % _NEWEST_EVERY == 0
            yield from self._send(lost.pop(-1 if newest else 0))

    def discard(self, key: int) -> None:
        """Its payload is of no use to anybody."""
        self._forget(key)
        self._useless += 1

    def _send(self, entry: _Entry) -> Iterator[tuple[int, bytes]]:
        payload = entry.payload
        if payload is None and self._folder is not None:
            payload = self._folder.read(entry.label.key)
        if payload is None:  # the folder has said and counted it
            self._forget(entry.label.key)
            return
        entry.order, entry.again = self._next_order(), True
        yield entry.label.key, payload

    def _next_order(self) -> int:
        self._sendings += 1
        return self._sendings

    def _stored(self, label: Label, payload: bytes) -> bool:
        if self._folder is None:
            return False
        try:
            self._folder.write(label, payload)
        except OSError as error:
            self.unstored += 1
            if (more := self._complaints.due("disk")) is not None:
                log.error(
                    "%s takes no keyframes (%s; %d more since the last report): they are kept in memory and "
                    "would not survive a restart; free some space", self._folder.path, error.strerror, more,
                )  # fmt: skip
            return False
        return True

    def _forget(self, key: int) -> None:
        entry = self._entries.pop(key, None)
        if entry is not None:
            self.bytes -= entry.label.size
            if entry.payload is None and self._folder is not None:
                self._folder.remove(key)

    def _make_room(self, keep: int | None) -> None:
        """Throws away until the bounds hold; never the newest."""
        while self.bytes > self._limit and (key := self._least_useful(keep, False)) is not None:
            self._give_up(key)
        if self._folder is None:
            return
        while self._in_memory() > _MEMORY_BYTES and (key := self._least_useful(keep, True)) is not None:
            self._give_up(key)

    def _in_memory(self) -> int:
        return sum(e.label.size for e in self._entries.values() if e.payload is not None)

    def _give_up(self, key: int) -> None:
        self._forget(key)
        self.given_up += 1
        if (more := self._complaints.due("room")) is not None:
            log.warning(
                "keyframe %d is thrown away, never acknowledged: the queue is full (%d more since the last)",
                key, more,
            )  # fmt: skip

    def _least_useful(self, keep: int | None, memory_only: bool) -> int | None:
        there = [e for e in self._entries.values() if e.payload is not None or not memory_only]
        for entry in there:
            if entry.label.drive != self.drive and entry.label.key != keep and self.drive:
                return entry.label.key
        keys = [e.label.key for e in there]
        if not keys or keys == [keep]:
            return None
        views = np.array([e.label.view for e in there])
        return keys[least_useful(views, keys.index(keep) if keep in keys else None)]


def least_useful(
    views: np.ndarray,  # float64 [N, 6]
    keep: int | None,
) -> int:
    """Index of the view that is nearest to another; of such a pair, the one with the nearer third.

    Raises:
        ValueError: there is none to choose.
    """
    count = len(views)
    if count == 0 or (count == 1 and keep == 0):
        raise ValueError("no view may be thrown away")
    if count == 1:
        return 0
    apart, _ = cKDTree(views).query(views, k=min(3, count))  # the first is itself
    # A pair shares its distance (but for rounding): the third decides.
    for index in np.lexsort((apart[:, -1], np.round(apart[:, 1], 9))):
        if index != keep:
            return int(index)
    raise AssertionError("unreachable: there are at least two")
