"""Who looks at the page, and what each has not been told yet: the newest of each kind, never more."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass, field
from typing import Any


@dataclass(eq=False)
class EventSubscriber:
    """One open stream of server-sent events."""

    waiting: dict[str, bytes] = field(default_factory=dict)
    dropped: int = 0  # events that were replaced by newer ones before it took them
    _wake: asyncio.Event = field(default_factory=asyncio.Event)

    def push(self, kind: str, event: bytes) -> None:
        """Puts the newest of a kind before the viewer."""
        self.dropped += kind in self.waiting
        self.waiting[kind] = event
        self._wake.set()

    async def next_events(self) -> bytes:
        """All that waits; waits for it."""
        await self._wake.wait()
        self._wake.clear()
        events = b"".join(self.waiting.values())
        self.waiting.clear()
        return events


class EventHub:
    """All viewers; each event is encoded once for them."""

    def __init__(self) -> None:
        self.subscribers: set[EventSubscriber] = set()
        self._newest: dict[str, bytes] = {}
        self._dropped = 0  # of those who have left

    def __len__(self) -> int:
        return len(self.subscribers)

    @property
    def dropped(self) -> int:
        """Events that viewers were too slow for, since the start."""
        return self._dropped + sum(viewer.dropped for viewer in self.subscribers)

    def subscribe(self) -> EventSubscriber:
        """A new viewer; it has been told nothing."""
        if not self.subscribers:
            self._newest.clear()  # of when somebody last looked
        viewer = EventSubscriber()
        for kind, event in self._newest.items():
            viewer.push(kind, event)
        self.subscribers.add(viewer)
        return viewer

    def unsubscribe(self, viewer: EventSubscriber) -> None:
        """It looks no longer."""
        self.subscribers.discard(viewer)
        self._dropped += viewer.dropped

    def publish(self, kind: str, data: Any) -> None:
        """Tells all viewers, if it is anything new. What stands before "/" in `kind` is the event's name."""
        event = b"event: %s\ndata: %s\n\n" % (kind.partition("/")[0].encode(), as_json(data))
        if self._newest.get(kind) != event:
            self._newest[kind] = event
            for viewer in self.subscribers:
                viewer.push(kind, event)


def as_json(data: Any) -> bytes:
    """Strict JSON: NaN would be none."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).encode()
