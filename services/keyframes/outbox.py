"""Outbox of keyframes without acknowledgement: bounded in size, optionally on disk, sent again when lost.

Every keyframe is sent once when it is created. Messages are delivered in order; so when a keyframe is
acknowledged, all keyframes sent before it and not acknowledged are lost. Lost keyframes are sent again,
oldest first, up to `window` at a time; each acknowledgement permits the next one. New keyframes do not wait
for lost ones. While no acknowledgement is received at all, only the oldest keyframe is sent again, every
`retry_ns`.

If the outbox is full, the least useful keyframe is dropped: a keyframe of an earlier drive, for which no
mapper waits, else the one whose view is nearest to another view in the outbox.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from beamsplat.common.runtime.rate_limited_log import RateLimitedLog
from beamsplat.services.keyframes.queue_folder import QueueEntry, QueueFolder

log = logging.getLogger("beamsplat.keyframes")

_MEMORY_BYTES = 64_000_000  # largest size of the keyframes that could not be written to disk
_WRITTEN_LATER = 4  # keyframes from memory that are written with each new one
_NEWEST_EVERY = 4  # every fourth lost keyframe sent again is the newest


@dataclass
class _Pending:
    meta: QueueEntry
    payload: bytes | None  # None = on disk
    send_index: int | None = None  # of its latest transmission; None = to be sent again
    resent: bool = False  # its latest transmission was not its first


class Outbox:
    """Queue of keyframes until they are acknowledged; uses measurement times, so that replays are equal."""

    def __init__(self, limit_bytes: int, retry_ns: int, window: int, folder: Path | None = None) -> None:
        """Open the outbox with the keyframes stored in `folder`; without a folder it is in memory only.

        Args:
            limit_bytes: largest size of all payloads.
            retry_ns: time without acknowledgement after which the oldest keyframe is sent again.
            window: largest number of keyframes that are sent again and not yet acknowledged.
            folder: created if missing.

        Raises:
            ValueError: a limit that is not positive.
            UserError: the folder cannot be created.
        """
        if limit_bytes < 1 or retry_ns <= 0 or window < 1:
            raise ValueError(f"limits must be positive, got {limit_bytes} bytes, {retry_ns} ns, {window}")
        self._limit, self._retry_ns, self._window = limit_bytes, retry_ns, window
        self._folder = QueueFolder(folder) if folder is not None else None
        self._entries: dict[int, _Pending] = {}
        self._sent_count = self._resent_lost = 0  # transmissions in total; of lost keyframes
        self._last_ack_ns: int | None = None  # time of the last acknowledgement or retry
        self._discarded = 0
        self._rate_limit = RateLimitedLog()
        self.drive = ""  # name of the current drive
        self.bytes = 0
        self.dropped = 0  # never acknowledged, removed because the outbox was full
        if self._folder is not None:
            for label in self._folder.entries():
                self._entries[label.key] = _Pending(label, None)
                self.bytes += label.size
            self._enforce_limits(keep=None)

    def __len__(self) -> int:
        """Return the number of keyframes of the current drive that are not acknowledged."""
        return sum(entry.meta.drive == self.drive for entry in self._entries.values())

    def rename_drive(self, before: str, drive: str) -> None:
        """Rename the current drive from `before` (named after a process) to `drive` (named after its map)."""
        for entry in self._entries.values():
            if entry.meta.drive == before:
                entry.meta = replace(entry.meta, drive=drive)
        self.drive = drive

    @property
    def not_on_disk(self) -> int:
        """Return the number of keyframes that could not be written to the disk yet, and are in memory."""
        return 0 if self._folder is None else sum(e.payload is not None for e in self._entries.values())

    @property
    def disk_fault(self) -> str:
        """Return why keyframes cannot be written to the disk; "" if they can, or if none is configured."""
        return "" if self._folder is None else self._folder.fault

    @property
    def of_earlier_drives(self) -> int:
        """Return the number of stored keyframes of earlier drives."""
        return len(self._entries) - len(self)

    @property
    def corrupt(self) -> int:
        """Return the number of keyframes that could not be read."""
        folder = self._folder
        return self._discarded + (folder.corrupt + folder.unreadable if folder is not None else 0)

    def put(self, key: int, view: np.ndarray, schema: str, payload: bytes, now_ns: int) -> None:
        """Store a keyframe that is being sent for the first time.

        Args:
            key: id of the keyframe.
            view: float64 [6], position and viewing direction in the map, in units of the distance and angle
                between keyframes.
            schema: name and version of the message.
            payload: the encoded message.
            now_ns: measurement time.
        """
        label = QueueEntry(key, self.drive, tuple(float(value) for value in view), len(payload), schema)
        self._forget(key)
        if not len(self):
            self._last_ack_ns = now_ns  # the retry time starts here
        written = self._written(label, payload)
        self._entries[key] = _Pending(label, None if written else payload, self._next_send_index())
        self.bytes += label.size
        if written:
            self._write_waiting()
        self._enforce_limits(keep=key)

    def _write_waiting(self) -> None:
        """Write the oldest keyframes that wait in memory for a disk that was full; few, to delay no step."""
        waiting = [entry for entry in self._entries.values() if entry.payload is not None]
        for entry in waiting[:_WRITTEN_LATER]:
            assert entry.payload is not None  # see above
            if not self._written(entry.meta, entry.payload):
                return
            entry.payload = None

    def acknowledge(self, key: int, now_ns: int) -> bool:
        """Remove an acknowledged keyframe; return False if the key is unknown.

        Keyframes that were sent before it and are still not acknowledged count as lost and become due again.
        `now_ns` is the time of the acknowledgement, in image time.
        """
        entry = self._entries.get(key)
        self._last_ack_ns = now_ns
        if entry is None:
            return False
        self._forget(key)
        for other in self._entries.values():
            if (
                entry.send_index is not None
                and other.send_index is not None
                and other.send_index < entry.send_index
            ):
                other.send_index = None
        return True

    def due(self, now_ns: int) -> Iterator[tuple[int, str, bytes]]:
        """Yield key, schema and payload of the keyframes that must be sent again now."""
        current = [entry for entry in self._entries.values() if entry.meta.drive == self.drive]
        if not current:
            return
        if self._last_ack_ns is None or now_ns - self._last_ack_ns >= self._retry_ns:
            self._last_ack_ns = now_ns
            yield from self._send(min(current, key=lambda entry: entry.meta.key))
            return
        in_flight = sum(entry.resent and entry.send_index is not None for entry in current)
        lost = sorted((e for e in current if e.send_index is None), key=lambda entry: entry.meta.key)
        for _ in range(min(self._window - in_flight, len(lost))):
            # Sometimes the newest: the current surroundings should not wait for the whole backlog.
            self._resent_lost += 1
            newest = self._resent_lost % _NEWEST_EVERY == 0
            yield from self._send(lost.pop(-1 if newest else 0))

    def discard(self, key: int) -> None:
        """Remove a keyframe whose payload cannot be used."""
        self._forget(key)
        self._discarded += 1

    def _send(self, entry: _Pending) -> Iterator[tuple[int, str, bytes]]:
        payload = entry.payload
        if payload is None and self._folder is not None:
            payload = self._folder.read(entry.meta.key)
        if payload is None:  # the folder has logged and counted it, and removed its file if it is corrupt
            del self._entries[entry.meta.key]
            self.bytes -= entry.meta.size
            return
        entry.send_index, entry.resent = self._next_send_index(), True
        yield entry.meta.key, entry.meta.schema, payload

    def _next_send_index(self) -> int:
        self._sent_count += 1
        return self._sent_count

    def _written(self, label: QueueEntry, payload: bytes) -> bool:
        if self._folder is None:
            return False
        try:
            self._folder.write(label, payload)
        except OSError as error:
            if (more := self._rate_limit.due("disk")) is not None:
                log.error(
                    "keyframes cannot be written to %s (%s; %d more since then): they are kept in memory "
                    "until the disk has room, and will be lost by a restart; free disk space",
                    self._folder.path, error.strerror, more,
                )  # fmt: skip
            return False
        return True

    def _forget(self, key: int) -> None:
        entry = self._entries.pop(key, None)
        if entry is not None:
            self.bytes -= entry.meta.size
            if entry.payload is None and self._folder is not None:
                self._folder.remove(key)

    def _enforce_limits(self, keep: int | None) -> None:
        """Drop keyframes until size and memory are within the limits, but never the keyframe `keep`."""
        while self.bytes > self._limit and (key := self._most_redundant(keep, False)) is not None:
            self._drop(key)
        if self._folder is None:
            return
        while self._in_memory() > _MEMORY_BYTES and (key := self._most_redundant(keep, True)) is not None:
            self._drop(key)

    def _in_memory(self) -> int:
        return sum(e.meta.size for e in self._entries.values() if e.payload is not None)

    def _drop(self, key: int) -> None:
        self._forget(key)
        self.dropped += 1
        if (more := self._rate_limit.due("room")) is not None:
            log.warning(
                "keyframe %d is dropped without acknowledgement: the queue is full (%d more since then)",
                key, more,
            )  # fmt: skip

    def _most_redundant(self, keep: int | None, memory_only: bool) -> int | None:
        candidates = [e for e in self._entries.values() if e.payload is not None or not memory_only]
        for entry in candidates:
            if entry.meta.drive != self.drive and entry.meta.key != keep and self.drive:
                return entry.meta.key
        keys = [e.meta.key for e in candidates]
        if not keys or keys == [keep]:
            return None
        views = np.array([e.meta.view for e in candidates])
        return keys[most_redundant(views, keys.index(keep) if keep in keys else None)]


def most_redundant(
    views: np.ndarray,  # float64 [N, 6]
    keep: int | None,
) -> int:
    """Return the index of the view that is nearest to another view, except `keep`.

    Both views of a pair have the same distance; the view with the nearer third neighbour is returned.

    Raises:
        ValueError: there is no view except `keep`.
    """
    count = len(views)
    if count == 0 or (count == 1 and keep == 0):
        raise ValueError("no view may be dropped")
    if count == 1:
        return 0
    found = cKDTree(views).query(views, k=min(3, count))
    distance = np.asarray(found[0])  # the first is itself
    # Both views of a pair have the same distance, except for rounding: the third neighbour decides.
    for index in np.lexsort((distance[:, -1], np.round(distance[:, 1], 9))):
        if index != keep:
            return int(index)
    raise AssertionError("unreachable: there are at least two views")
