"""The link between robot and edge: a TCP proxy that can be cut, or stall like radio without reception."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from typing import Literal

LinkState = Literal["up", "cut", "stalled"]
_CHUNK_BYTES = 65536


class LinkProxy:
    """Forwards TCP connections to a port of this host, in a thread; all methods are thread-safe.

    `cut`: connections are closed, new ones are closed at once. `stalled`: connections stay open, and nothing
    passes, as when packets are lost without an answer.
    """

    def __init__(self, target_port: int) -> None:
        """Start to listen at a free port of the loopback interface, `port`."""
        self._target_port = target_port
        self._state: LinkState = "up"
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._flowing = asyncio.Event()
        started = threading.Event()

        async def listen() -> None:
            server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
            self.port = int(server.sockets[0].getsockname()[1])
            self._flowing.set()
            started.set()
            await server.serve_forever()

        def run() -> None:
            asyncio.set_event_loop(self._loop)
            self._loop.run_until_complete(listen())

        threading.Thread(target=run, name="link", daemon=True).start()
        started.wait()

    @property
    def state(self) -> LinkState:
        """Return the state of the link."""
        return self._state

    def set(self, state: LinkState) -> None:
        """Change the state of the link."""
        self._loop.call_soon_threadsafe(self._set, state)

    def _set(self, state: LinkState) -> None:
        self._state = state
        if state == "stalled":
            self._flowing.clear()
        else:
            self._flowing.set()
        if state == "cut":
            for writer in list(self._writers):
                writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._state == "cut":
            writer.transport.abort()
            return
        try:
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._target_port)
        except OSError:
            writer.transport.abort()
            return
        pair = (writer, far_writer)
        self._writers.update(pair)
        try:
            await asyncio.gather(self._pump(reader, far_writer), self._pump(far_reader, writer))
        finally:
            self._writers.difference_update(pair)
            for end in pair:
                end.transport.abort()

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Forward until either side closes; a half-closed connection is closed."""
        with contextlib.suppress(OSError):
            while data := await reader.read(_CHUNK_BYTES):
                await self._flowing.wait()
                writer.write(data)
                await writer.drain()
        writer.transport.abort()
