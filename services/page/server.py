"""The page's HTTP server, in its own thread: the node never waits for a browser.

GET /                     the page; its parts are /page.js, /page.css ...
GET /events               server-sent events: status, scale, path, robot, picture (a newer image is available)
GET /picture/NAME         the newest image: camera, depth, render or map
GET /status               the data of the status event, for scripts
POST /command             {"action": "restart", "node": "depth"}, with "Authorization: Bearer TOKEN";
                          also params (returns the node's options); swap and "cold swap" take
                          {"parameters": {OPTION: VALUE}}

Everything is encoded once for all pages. Events that a page has not received yet are replaced by newer ones.
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

from beamsplat.services.page.events import EventHub, as_json
from beamsplat.services.page.http import (
    MAX_HEAD_BYTES,
    STREAM_HEAD,
    HttpError,
    HttpRequest,
    is_own_host,
    make_response,
    own_host_names,
    read_request,
)
from beamsplat.services.page.view import PageState

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
_MAX_COMMANDS = 4  # at the same time
_SEND_TIMEOUT_S = 20.0  # a connection that accepts no data for so long is closed
_WRONG_TOKEN_DELAY_S = 1.0  # slows down guessing
_BUSY = (HTTPStatus.SERVICE_UNAVAILABLE, "too many requests at the same time: try again")

Command = Callable[[str, str, dict[str, str]], str]  # (action, node, parameters) -> result text


@dataclass(frozen=True)
class PageAccess:
    """Access control of the page: token for commands, accepted host names."""

    token: str = ""  # for commands; "": commands are disabled
    names: frozenset[str] = frozenset()  # accepted host names, besides the machine's own


class PageServer:
    """HTTP server of one `PageState`; call `start()`, then `close()`."""

    def __init__(self, state: PageState, command: Command, access: PageAccess, robot_hz: float) -> None:
        self._state = state
        self._command = command
        self._access = access
        self._names = own_host_names() | access.names
        self._robot_hz = robot_hz
        self._files = {path: ((_STATIC / name).read_bytes(), kind) for path, (name, kind) in _FILES.items()}
        self.events = EventHub()
        self._connections: set[asyncio.Task[None]] = set()
        self._commands = 0
        self._encoder = ThreadPoolExecutor(1, "page-encoder")
        self._command_executor = ThreadPoolExecutor(_MAX_COMMANDS, "page-command")
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="page", daemon=True)
        self._server: asyncio.Server | None = None
        self.rejected_commands = 0  # commands with a wrong token

    def start(self, bind: str, port: int, tls: ssl.SSLContext | None) -> int:
        """Start listening; return the port (a free one if `port` is 0).

        Raises:
            OSError: the port is in use, or `bind` is no address of this machine.
        """
        self._thread.start()
        return asyncio.run_coroutine_threadsafe(self._open(bind, port, tls), self._loop).result()

    async def _open(self, bind: str, port: int, tls: ssl.SSLContext | None) -> int:
        self._encode_locks = {name: asyncio.Lock() for name in self._state.images}
        self._server = await asyncio.start_server(self._serve, bind, port, limit=MAX_HEAD_BYTES, ssl=tls)
        self._publishing = asyncio.create_task(self._publish_periodically())
        return self._server.sockets[0].getsockname()[1]

    def check(self) -> None:
        """Raise the exception that ended the event task, if any; without it, the page is outdated."""
        if self._publishing.done() and not self._publishing.cancelled():
            self._publishing.result()

    def close(self) -> None:
        """Close all connections and end the thread."""
        if self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._close_all(), self._loop).result()
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
        self._encoder.shutdown(wait=False, cancel_futures=True)
        self._command_executor.shutdown(wait=False, cancel_futures=True)

    async def _close_all(self) -> None:
        if self._server is None:  # start() failed
            return
        self._server.close()
        ending = {self._publishing, *self._connections}
        for task in ending:
            task.cancel()
        await asyncio.gather(*ending, return_exceptions=True)

    # --- events to all pages ---

    async def _publish_periodically(self) -> None:
        """Publish the robot's pose at `robot_hz` and other events once per second, while a page is open."""
        beat = 0
        while True:
            await asyncio.sleep(1.0 / self._robot_hz)
            if self.events:
                self._publish_all(slow=beat <= 0)
                beat = round(self._robot_hz) - 1 if beat <= 0 else beat - 1
                for name, image in self._state.images.items():
                    if image.due() and not self._encode_locks[name].locked():
                        await self._encode_if_due(name)

    def _publish_all(self, slow: bool) -> None:
        self.events.publish("robot", self._state.robot())
        if slow:
            self.events.publish("status", self._status())
            self.events.publish("scale", self._state.scales())
            self.events.publish("path", self._state.path())

    def _status(self) -> dict[str, Any]:
        facts = {
            "viewers": len(self.events),
            "overtaken": self.events.dropped,
            "commands": bool(self._access.token),
        }
        return {**self._state.status(), "page": facts}

    async def _encode_if_due(self, name: str) -> None:
        """Encode the image `name` if it is due; concurrent callers wait for the same encoding."""
        image = self._state.images[name]
        async with self._encode_locks[name]:
            if not image.due():
                return
            await self._loop.run_in_executor(self._encoder, image.encode_newest)
        self._publish_image(name)

    def _publish_image(self, name: str) -> None:
        if (facts := self._state.images[name].metadata()) is not None:
            self.events.publish(f"picture/{name}", {"name": name, **facts})

    # --- one connection ---

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None  # asyncio calls this in a task
        self._connections.add(task)
        # A small socket buffer keeps events in our queue, where newer ones can replace them.
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BYTES)
        writer.transport.set_write_buffer_limits(high=0)
        try:
            with contextlib.suppress(ConnectionError, TimeoutError, asyncio.CancelledError):
                await self._handle_requests(reader, writer)
        finally:
            self._connections.discard(task)
            writer.close()

    async def _handle_requests(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while (request := await read_request(reader)) is not None:
                if request.path == "/events" and request.method == "GET":
                    await self._stream(request, writer)
                    return
                await _send(writer, await self._answer(request))
        except HttpError as error:
            await _send(writer, _error_response(error))

    def _check_host(self, request: HttpRequest) -> None:
        if len(self._connections) > _MAX_CONNECTIONS:
            raise HttpError(*_BUSY)
        if not is_own_host(request.headers.get("host", ""), self._names):
            raise HttpError(HTTPStatus.MISDIRECTED_REQUEST, "unknown host name: add it to the option `names`")

    async def _stream(self, request: HttpRequest, writer: asyncio.StreamWriter) -> None:
        self._check_host(request)
        writer.write(STREAM_HEAD)
        viewer = self.events.subscribe()
        try:
            self._publish_all(slow=True)
            for name in self._state.images:
                self._publish_image(name)
            while True:
                await _send(writer, await viewer.next_events())
        finally:
            self.events.unsubscribe(viewer)

    async def _answer(self, request: HttpRequest) -> bytes:
        try:
            self._check_host(request)
            if request.path == "/command":
                return _json_response(await self._run_command(request))
            if request.method != "GET":
                raise HttpError(HTTPStatus.METHOD_NOT_ALLOWED, "only GET is allowed")
            if request.path == "/status":
                return _json_response(self._status())
            if request.path in self._files:
                body, kind = self._files[request.path]
                return make_response(HTTPStatus.OK, kind, body)
            return await self._image_response(request.path)
        except HttpError as error:
            return _error_response(error)

    async def _image_response(self, path: str) -> bytes:
        name = path.removeprefix("/picture/")
        if name not in self._state.images or not path.startswith("/picture/"):
            raise HttpError(HTTPStatus.NOT_FOUND, "not found")
        await self._encode_if_due(name)
        encoded = self._state.images[name].encoded
        if encoded is None:
            raise HttpError(HTTPStatus.NOT_FOUND, f"no {name} yet")
        return make_response(HTTPStatus.OK, encoded.content_type, encoded.data)

    # --- commands ---

    async def _run_command(self, request: HttpRequest) -> dict[str, str]:
        """Execute the command in a request of an authorized user; return the response as a dictionary."""
        if request.method != "POST":
            raise HttpError(HTTPStatus.METHOD_NOT_ALLOWED, "commands need POST")
        await self._check_token(request)
        try:
            command = json.loads(request.body)
            action, node = str(command["action"]), str(command.get("node", ""))
            parameters = {str(k): str(v) for k, v in command.get("parameters", {}).items()}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise HttpError(
                HTTPStatus.BAD_REQUEST, 'not a command: send {"action": ..., "node": ...}'
            ) from error
        if self._commands >= _MAX_COMMANDS:
            raise HttpError(*_BUSY)
        self._commands += 1
        try:
            done = await self._loop.run_in_executor(
                self._command_executor, self._command, action, node, parameters
            )
        except ValueError as error:
            raise HttpError(HTTPStatus.CONFLICT, str(error)) from error
        finally:
            self._commands -= 1
        return {"text": done}

    async def _check_token(self, request: HttpRequest) -> None:
        if not self._access.token:
            raise HttpError(HTTPStatus.FORBIDDEN, "commands are disabled: the page's option `token` is empty")
        given = request.headers.get("authorization", "").removeprefix("Bearer ")
        if not hmac.compare_digest(given.encode(), self._access.token.encode()):
            self.rejected_commands += 1
            await asyncio.sleep(_WRONG_TOKEN_DELAY_S)
            raise HttpError(HTTPStatus.UNAUTHORIZED, "wrong token: see the page's option `token`")


async def _send(writer: asyncio.StreamWriter, data: bytes) -> None:
    writer.write(data)
    async with asyncio.timeout(_SEND_TIMEOUT_S):
        await writer.drain()


def _json_response(data: dict[str, Any]) -> bytes:
    return make_response(HTTPStatus.OK, "application/json", as_json(data))


def _error_response(error: HttpError) -> bytes:
    return make_response(error.status, "application/json", as_json({"error": str(error)}))
