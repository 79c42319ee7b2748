"""Serves the page, from a thread of its own: the node never waits for a browser.

GET /                     the page; its parts are /page.js, /page.css
GET /events               server-sent events: status, scale, path, robot, picture (a newer one is there)
GET /picture/NAME         the newest camera, depth, render or map
GET /status               what the status event holds, for scripts
POST /command             {"action": "restart", "node": "depth"}, with "Authorization: Bearer TOKEN";
                          also params (its options); swap and "cold swap" take {"parameters": {OPTION: VALUE}}

Everything is encoded once for all viewers. What a viewer has not taken yet is replaced by what is newer.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import socket
import ssl
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any

from beamsplat.services.page.audience import Audience, as_json
from beamsplat.services.page.http import (
    MAX_HEAD_BYTES,
    STREAM_HEAD,
    Refused,
    Request,
    is_own_name,
    own_names,
    read_request,
    reply,
)
from beamsplat.services.page.view import View

_STATIC = Path(__file__).parent / "static"
_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/map.js": ("map.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
_MAX_CONNECTIONS = 128
_SEND_BYTES = 64 * 1024
_MAX_COMMANDS = 4  # at a time
_STALLED_S = 20.0  # a browser that takes nothing for so long is given up
_WRONG_TOKEN_S = 1.0  # a wrong token's answer takes its time
_BUSY = (HTTPStatus.SERVICE_UNAVAILABLE, "too much at once: try again")

Command = Callable[[str, str, dict[str, str]], str]  # (action, node, parameters) -> what was done


@dataclass(frozen=True)
class Access:
    """Who may do what, from where."""

    token: str = ""  # for commands; "": nobody
    names: frozenset[str] = frozenset()  # by which this machine is asked for, besides its own


class PageServer:
    """The page of one `View`. `start()`, then `close()`."""

    def __init__(self, view: View, command: Command, access: Access, beat_hz: float) -> None:
        self._view = view
        self._command = command
        self._access = access
        self._names = own_names() | access.names
        self._beat_hz = beat_hz
        self._files = {path: ((_STATIC / name).read_bytes(), kind) for path, (name, kind) in _FILES.items()}
        self.audience = Audience()
        self._connections: set[asyncio.Task[None]] = set()
        self._commands = 0
        self._encoder = ThreadPoolExecutor(1, "page-encoder")
        self._commander = ThreadPoolExecutor(_MAX_COMMANDS, "page-command")
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="page", daemon=True)
        self._server: asyncio.Server | None = None
        self.refused = 0  # commands without the right

    def start(self, bind: str, port: int, tls: ssl.SSLContext | None) -> int:
        """Listens; returns the port, a free one for 0.

        Raises:
            OSError: the port is taken, or `bind` is no address of this machine.
        """
        self._thread.start()
        return asyncio.run_coroutine_threadsafe(self._open(bind, port, tls), self._loop).result()

    async def _open(self, bind: str, port: int, tls: ssl.SSLContext | None) -> int:
        self._slots = {name: asyncio.Lock() for name in self._view.pictures}
        self._server = await asyncio.start_server(self._serve, bind, port, limit=MAX_HEAD_BYTES, ssl=tls)
        self._beating = asyncio.create_task(self._beat())
        return self._server.sockets[0].getsockname()[1]

    def check(self) -> None:
        """Raises what has ended the events, if anything has: a page that stands still helps nobody."""
        if self._beating.done() and not self._beating.cancelled():
            self._beating.result()

    def close(self) -> None:
        """Ends all connections and the thread."""
        if self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._shut(), self._loop).result()
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
        self._encoder.shutdown(wait=False, cancel_futures=True)
        self._commander.shutdown(wait=False, cancel_futures=True)

    async def _shut(self) -> None:
        if self._server is None:  # it could not listen
            return
        self._server.close()
        ending = {self._beating, *self._connections}
        for task in ending:
            task.cancel()
        await asyncio.gather(*ending, return_exceptions=True)

    # --- what goes to all ---

    async def _beat(self) -> None:
        """The robot at `beat_hz`, the rest once a second; nothing is made while nobody looks."""
        beat = 0
        while True:
            await asyncio.sleep(1.0 / self._beat_hz)
            if self.audience:
                self._tell_all(slow=beat <= 0)
                beat = round(self._beat_hz) - 1 if beat <= 0 else beat - 1
                for name, picture in self._view.pictures.items():
                    if picture.due() and not self._slots[name].locked():
                        await self._refresh(name)

    def _tell_all(self, slow: bool) -> None:
        self.audience.tell("robot", self._view.robot())
        if slow:
            self.audience.tell("status", self._status())
            self.audience.tell("scale", self._view.scales())
            self.audience.tell("path", self._view.path())

    def _status(self) -> dict[str, Any]:
        facts = {
            "viewers": len(self.audience),
            "overtaken": self.audience.overtaken,
            "commands": bool(self._access.token),
        }
        return {**self._view.status(), "page": facts}

    async def _refresh(self, name: str) -> None:
        """Encodes a picture if it is due; who comes meanwhile waits for the same one."""
        picture = self._view.pictures[name]
        async with self._slots[name]:
            if not picture.due():
                return
            await self._loop.run_in_executor(self._encoder, picture.refresh)
        self._tell_picture(name)

    def _tell_picture(self, name: str) -> None:
        if (facts := self._view.pictures[name].facts()) is not None:
            self.audience.tell(f"picture/{name}", {"name": name, **facts})

    # --- one connection ---

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        self._connections.add(task)
        # What the system's small buffer does not take waits here, where newer things can replace it.
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BYTES)
        writer.transport.set_write_buffer_limits(high=0)
        try:
            with contextlib.suppress(ConnectionError, TimeoutError, asyncio.CancelledError):
                await self._converse(reader, writer)
        finally:
            self._connections.discard(task)
            writer.close()

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while (request := await read_request(reader)) is not None:
                if request.path == "/events" and request.method == "GET":
                    await self._stream(request, writer)
                    return
                await _send(writer, await self._answer(request))
        except Refused as error:
            await _send(writer, _error(error))

    def _admit(self, request: Request) -> None:
        if len(self._connections) > _MAX_CONNECTIONS:
            raise Refused(*_BUSY)
        if not is_own_name(request.headers.get("host", ""), self._names):
            raise Refused(HTTPStatus.MISDIRECTED_REQUEST, "not a name of this machine (option `names`)")

    async def _stream(self, request: Request, writer: asyncio.StreamWriter) -> None:
        self._admit(request)
        writer.write(STREAM_HEAD)
        viewer = self.audience.join()
        try:
            self._tell_all(slow=True)
            for name in self._view.pictures:
                self._tell_picture(name)
            while True:
                await _send(writer, await viewer.take())
        finally:
            self.audience.leave(viewer)

    async def _answer(self, request: Request) -> bytes:
        try:
            self._admit(request)
            if request.path == "/command":
                return _good(await self._obey(request))
            if request.method != "GET":
                raise Refused(HTTPStatus.METHOD_NOT_ALLOWED, "only GET here")
            if request.path == "/status":
                return _good(self._status())
            if request.path in self._files:
                body, kind = self._files[request.path]
                return reply(HTTPStatus.OK, kind, body)
            return await self._picture(request.path)
        except Refused as error:
            return _error(error)

    async def _picture(self, path: str) -> bytes:
        name = path.removeprefix("/picture/")
        if name not in self._view.pictures or not path.startswith("/picture/"):
            raise Refused(HTTPStatus.NOT_FOUND, "nothing here")
        await self._refresh(name)
        encoded = self._view.pictures[name].encoded
        if encoded is None:
            raise Refused(HTTPStatus.NOT_FOUND, f"no {name} yet")
        return reply(HTTPStatus.OK, encoded.content_type, encoded.data)

    # --- commands ---

    async def _obey(self, request: Request) -> dict[str, str]:
        """Carries out a command of somebody who may give it."""
        if request.method != "POST":
            raise Refused(HTTPStatus.METHOD_NOT_ALLOWED, "commands are given by POST")
        await self._check_right(request)
        try:
            wish = json.loads(request.body)
            action, node = str(wish["action"]), str(wish.get("node", ""))
            parameters = {str(k): str(v) for k, v in wish.get("parameters", {}).items()}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise Refused(HTTPStatus.BAD_REQUEST, 'no command: {"action": ..., "node": ...}') from error
        if self._commands >= _MAX_COMMANDS:
            raise Refused(*_BUSY)
        self._commands += 1
        try:
            done = await self._loop.run_in_executor(self._commander, self._command, action, node, parameters)
        except ValueError as error:
            raise Refused(HTTPStatus.CONFLICT, str(error)) from error
        finally:
            self._commands -= 1
        return {"text": done}

    async def _check_right(self, request: Request) -> None:
        if not self._access.token:
            raise Refused(HTTPStatus.FORBIDDEN, "this page takes no commands: it has no token in its options")
        given = request.headers.get("authorization", "").removeprefix("Bearer ")
        if not hmac.compare_digest(given.encode(), self._access.token.encode()):
            self.refused += 1
            await asyncio.sleep(_WRONG_TOKEN_S)
            raise Refused(HTTPStatus.UNAUTHORIZED, "not the token that this page's options hold")


async def _send(writer: asyncio.StreamWriter, data: bytes) -> None:
    writer.write(data)
    async with asyncio.timeout(_STALLED_S):
        await writer.drain()


def _good(data: dict[str, Any]) -> bytes:
    return reply(HTTPStatus.OK, "application/json", as_json(data))


def _error(error: Refused) -> bytes:
    return reply(error.status, "application/json", as_json({"error": str(error)}))
