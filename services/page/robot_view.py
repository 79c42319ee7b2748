"""One robot on the page: its event streams, and the encoding of its images once for all viewers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any

from beamsplat.services.page.events import SCAN, EventHub
from beamsplat.services.page.map3d.source import MapSource
from beamsplat.services.page.view import PageState

_SCAN_S, _MAP_S = 0.2, 0.5  # shortest time between two events


class RobotView:
    """Events and images of one robot; used in the server's thread only."""

    def __init__(
        self, state: PageState, facts: Callable[[RobotView], dict[str, Any]], encoder: Executor,
        map3d: MapSource,
    ) -> None:  # fmt: skip
        """Create the view.

        Args:
            state: of the robot.
            facts: returns what the status has besides the state: alerts, and facts about the page.
            encoder: encodes the images.
            map3d: the robot's map.
        """
        self.state, self.events, self.map3d = state, EventHub(), map3d
        self._facts, self._encoder = facts, encoder
        self._locks = {name: asyncio.Lock() for name in state.images}
        self._next_slow_s = self._next_scan_s = self._next_map_s = 0.0

    def status(self) -> dict[str, Any]:
        """Return the data of the status event."""
        return {**self.state.status(), **self._facts(self)}

    def publish(self, now_s: float | None) -> None:
        """Publish the robot's pose, and once per second all else; None: everything, for a new viewer."""
        self.events.publish("robot", self.state.robot())
        if self.events.scan_wanted and (now_s is None or now_s >= self._next_scan_s):
            if now_s is not None:
                self._next_scan_s = now_s + _SCAN_S
            self.events.publish(SCAN, self.state.scan3d())
        if self.map3d.active and (now_s is None or now_s >= self._next_map_s):
            if now_s is not None:
                self._next_map_s = now_s + _MAP_S
            if self.events.scan_wanted:  # by a viewer of the map, which need not ask for anything meanwhile
                self.map3d.want()
            self.events.publish(
                "map3d", {"producer": self.map3d.map.producer, "revision": self.map3d.map.revision}
            )
        if now_s is None or now_s >= self._next_slow_s:
            if now_s is not None:
                self._next_slow_s = now_s + 1.0
            self.events.publish("status", self.status())
            self.events.publish("scale", self.state.scales())
            self.events.publish("path", self.state.path())

    def publish_image(self, name: str) -> None:
        """Publish that there is an image `name`, if there is one."""
        if (facts := self.state.images[name].metadata()) is not None:
            self.events.publish(f"picture/{name}", {"name": name, **facts})

    async def encode_if_due(self, name: str) -> None:
        """Encode the image `name` if it is due; concurrent callers wait for the same encoding."""
        image = self.state.images[name]
        async with self._locks[name]:
            if not image.due():
                return
            await asyncio.get_running_loop().run_in_executor(self._encoder, image.encode_newest)
        self.publish_image(name)

    async def encode_due_images(self) -> None:
        """Encode the images that are due and that nobody encodes yet."""
        for name, image in self.state.images.items():
            if image.due() and not self._locks[name].locked():
                await self.encode_if_due(name)
