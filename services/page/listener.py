"""Accept the connections of the page's server; their number is limited from the moment they are accepted.

asyncio's own server accepts without a limit, so that connections that send nothing use up the descriptors of
the process. Here, a new connection beyond the limit replaces the oldest one without a request: browsers keep
idle connections for later requests, and open a new one if it was closed.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl

from aiohttp import web

log = logging.getLogger(__name__)

MAX_CONNECTIONS = 128
HANDSHAKE_S = 10.0  # a TLS connection without a complete handshake is closed
_SHUTDOWN_S = 2.0  # for the last messages of a TLS connection
_SEND_BYTES = 64 * 1024  # a small socket buffer keeps events in our queue, where newer ones can replace them
_RETRY_S = 1.0  # after accepting failed: the process has no descriptor left


class Listener:
    """Listens at an address and hands the connections to an aiohttp server.

    `busy` contains the connections with a request in progress, which are never replaced; the server's
    middleware keeps it up to date.
    """

    def __init__(self, server: web.Server, tls: ssl.SSLContext | None) -> None:
        self._server, self._tls = server, tls
        self.busy: set[web.RequestHandler] = set()
        self.replaced = 0  # connections closed because of the limit
        self._sockets: list[socket.socket] = []
        self._accepting: list[asyncio.Task[None]] = []
        self._connecting: dict[asyncio.Task[None], None] = {}  # TLS handshakes in progress, oldest first

    async def listen(self, bind: str, port: int) -> int:
        """Listen at all addresses of the host `bind`; return the port (a free one if `port` is 0).

        Raises:
            OSError: the port is in use, or `bind` is no address of this machine.
        """
        loop = asyncio.get_running_loop()
        try:
            for family, *_, address in await loop.getaddrinfo(bind, port, type=socket.SOCK_STREAM):
                listening = socket.create_server(
                    (address[0], port, *address[2:]), family=family, backlog=MAX_CONNECTIONS
                )
                listening.setblocking(False)
                listening.setsockopt(
                    socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BYTES
                )  # accepted ones inherit it
                self._sockets.append(listening)
                port = listening.getsockname()[1]
        except OSError:
            self._close_sockets()
            raise
        self._accepting = [asyncio.create_task(self._accept(listening)) for listening in self._sockets]
        return port

    async def close(self) -> None:
        """Stop listening; open connections remain."""
        ending = [*self._accepting, *self._connecting]
        for task in ending:
            task.cancel()
        await asyncio.gather(*ending, return_exceptions=True)
        self._close_sockets()

    def _close_sockets(self) -> None:
        for listening in self._sockets:
            listening.close()
        self._sockets.clear()

    async def _accept(self, listening: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, _ = await loop.sock_accept(listening)
            except OSError as error:
                log.error("no connection can be accepted (%s)", error.strerror)
                await asyncio.sleep(_RETRY_S)
                continue
            if self._make_room():
                task = asyncio.create_task(self._connect(connection))
                self._connecting[task] = None
                task.add_done_callback(lambda done: self._connecting.pop(done, None))
            else:
                connection.close()
            await asyncio.sleep(0)  # sock_accept does not yield while connections are waiting

    async def _connect(self, connection: socket.socket) -> None:
        tls = self._tls is not None
        try:
            transport, _ = await asyncio.get_running_loop().connect_accepted_socket(
                self._server, connection, ssl=self._tls,
                ssl_handshake_timeout=HANDSHAKE_S if tls else None,
                ssl_shutdown_timeout=_SHUTDOWN_S if tls else None,
            )  # fmt: skip
        except OSError:  # the client closed the connection, or the handshake failed
            return
        transport.set_write_buffer_limits(high=0)

    def _make_room(self) -> bool:
        """Return whether one more connection may be opened; replace one if there are `MAX_CONNECTIONS`."""
        open_ones = [
            c for c in self._server.connections if c.transport is not None and not c.transport.is_closing()
        ]
        if len(open_ones) + len(self._connecting) < MAX_CONNECTIONS:
            return True
        self.replaced += 1
        for connection in open_ones:  # oldest first
            if connection not in self.busy and connection.transport is not None:
                connection.transport.abort()
                return True
        if not self._connecting:
            return False
        handshake = next(iter(self._connecting))
        del self._connecting[handshake]
        handshake.cancel()
        return True
