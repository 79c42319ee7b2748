"""Distribution of server-sent events to all open pages; each receives only the newest event of each kind."""

from __future__ import annotations

import asyncio
import contextlib
import json
from dataclasses import dataclass, field
from typing import Any

SCAN = "scan3d"  # the kind of event that only those streams receive that have asked for it


@dataclass(eq=False)
class EventSubscriber:
    """One open event stream: the connection of one page."""

    wants_scan: bool = False  # a viewer of the 3D map: receives the events `scan3d`
    waiting: dict[str, bytes] = field(default_factory=dict)
    dropped: int = 0  # events replaced by newer ones before they were sent
    _wake: asyncio.Event = field(default_factory=asyncio.Event)

    def push(self, kind: str, event: bytes) -> None:
        """Queue an event; it replaces a queued event of the same kind."""
        self.dropped += kind in self.waiting
        self.waiting[kind] = event
        self._wake.set()

    async def next_events(self, timeout_s: float) -> bytes:
        """Wait until events are queued; remove all queued events and return their bytes.

        After the time-out, the result is empty.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._wake.wait()
        self._wake.clear()
        events = b"".join(self.waiting.values())
        self.waiting.clear()
        return events


class EventHub:
    """All open event streams; each event is encoded once for all streams."""

    def __init__(self) -> None:
        self.subscribers: set[EventSubscriber] = set()
        self._newest: dict[str, bytes] = {}
        self._dropped = 0  # of streams that have ended

    def __len__(self) -> int:
        return len(self.subscribers)

    @property
    def dropped(self) -> int:
        """Return the number of events, since the start, that were replaced before they were sent."""
        return self._dropped + sum(viewer.dropped for viewer in self.subscribers)

    @property
    def scan_wanted(self) -> bool:
        """Return whether a stream receives the events `scan3d`."""
        return any(viewer.wants_scan for viewer in self.subscribers)

    def subscribe(self, wants_scan: bool = False) -> EventSubscriber:
        """Register a new stream; it receives the newest event of each kind first."""
        if not self.subscribers:
            self._newest.clear()  # outdated: nothing is published without subscribers
        viewer = EventSubscriber(wants_scan)
        for kind, event in self._newest.items():
            if wants_scan or kind != SCAN:
                viewer.push(kind, event)
        self.subscribers.add(viewer)
        return viewer

    def unsubscribe(self, viewer: EventSubscriber) -> None:
        """Unregister a stream; its queued events are discarded."""
        self.subscribers.discard(viewer)
        self._dropped += viewer.dropped

    def publish(self, kind: str, data: Any) -> None:
        """Send data to all streams, unless equal to the last data of this kind.

        The part of `kind` before "/" is the name of the event.
        """
        event = b"event: %s\ndata: %s\n\n" % (kind.partition("/")[0].encode(), as_json(data))
        if self._newest.get(kind) != event:
            self._newest[kind] = event
            for viewer in self.subscribers:
                if viewer.wants_scan or kind != SCAN:
                    viewer.push(kind, event)


def as_json(data: Any) -> bytes:
    """Return data as JSON.

    Raises:
        ValueError: the data contain NaN or infinity, which JSON does not have.
    """
    return json.dumps(data, separators=(",", ":"), allow_nan=False).encode()
