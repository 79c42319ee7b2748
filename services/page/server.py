"""The page's HTTP server, in its own thread: the node never waits for a browser.

GET /                     the page; its parts are /page.js, /page.css ...
GET /events               server-sent events: status, scale, path, robot, picture (a newer image is available)
GET /picture/NAME         the newest image: camera, depth, render or map
GET /status               the data of the status event, for scripts
GET /metrics              Prometheus metrics of all robots that the page knows
GET /fleet                the list of these robots, from GET /robots; GET /robots/NAME/ is the page of one of
                          them, with /robots/NAME/events, /picture/NAME and /status as above
POST /command             {"action": "restart", "node": "depth"}, with "Authorization: Bearer TOKEN";
                          also params (returns the node's options); swap and "cold swap" take
                          {"parameters": {OPTION: VALUE}}

Everything is encoded once for all pages. Events that a page has not received yet are replaced by newer ones.
aiohttp reads the requests; the limits on connections, sizes and times are set here and in `listener`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import ssl
import threading
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from beamsplat.services.page.access import PageAccess
from beamsplat.services.page.alerting import Alerting
from beamsplat.services.page.events import EventHub, as_json
from beamsplat.services.page.fleet import Fleet
from beamsplat.services.page.listener import MAX_CONNECTIONS, Listener
from beamsplat.services.page.metrics import CONTENT_TYPE, page_metrics
from beamsplat.services.page.robot_view import RobotView

_http_log = logging.getLogger(f"{__name__}.http")
_STATIC = Path(__file__).parent / "static"
_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/map.js": ("map.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
    "/fleet": ("fleet.html", "text/html; charset=utf-8"),
    "/fleet.js": ("fleet.js", "text/javascript; charset=utf-8"),
}
_OF_FLEET = ("/fleet", "/fleet.js")  # the other files are also served for each robot
_ROBOT = "/robots/{robot}"
# No content from other origins, no inline scripts, no embedding in frames, no content sniffing, no caching.
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Server": "beamsplat",
}
_MAX_VIEWERS = MAX_CONNECTIONS // 2  # open event streams: the other connections remain for requests
_MAX_HEADERS = 64  # of a request, each of at most 8 kB (aiohttp's default)
_MAX_BODY_BYTES = 16 * 1024
_MAX_COMMANDS = 4  # at the same time
_IDLE_S = 20.0  # a connection without a complete request is closed
_TRANSFER_S = 20.0  # a connection whose request body or response takes longer is closed
_HEARTBEAT_S = (
    15.0  # after so long without an event, a comment is sent: it shows whether the page still reads
)
_HEARTBEAT = b":\n\n"
_WRONG_TOKEN_DELAY_S = 1.0  # slows down guessing
_LINGER_S = 2.0  # for the rest of a refused request, so that the client reads the response
_CLOSE_S = 0.1  # for requests in progress when the server is closed
_BUSY = (HTTPStatus.SERVICE_UNAVAILABLE, "too many requests at the same time: try again")

Command = Callable[[str, str, dict[str, str]], str]  # (action, node, parameters) -> result text
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class RefusedRequest(Exception):
    """Error: a request that is answered with an error status and a text."""

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


class _ProtocolErrors(logging.Filter):
    """Counts requests that are not HTTP, in place of a traceback in the log for each."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def filter(self, record: logging.LogRecord) -> bool:
        if record.exc_info and isinstance(record.exc_info[1], HttpProcessingError):
            self.count += 1
            return False
        return True


class PageServer:
    """HTTP server of the robots of a `Fleet`; call `start()`, then `close()`."""

    def __init__(
        self, fleet: Fleet, alerting: Alerting, command: Command, access: PageAccess, robot_hz: float
    ) -> None:
        self._fleet, self._alerting = fleet, alerting
        self._command = command
        self._access = access
        self._robot_hz = robot_hz
        self._files = {path: ((_STATIC / name).read_bytes(), kind) for path, (name, kind) in _FILES.items()}
        self._encoder = ThreadPoolExecutor(1, "page-encoder")
        self._views: dict[str, RobotView] = {}  # by robot; used in the server's thread
        self._commands = 0
        self._command_executor = ThreadPoolExecutor(_MAX_COMMANDS, "page-command")
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="page", daemon=True)
        self._runner: web.AppRunner | None = None
        self._listener: Listener | None = None
        self._publishing: asyncio.Task[None] | None = None
        self._protocol_errors = _ProtocolErrors()
        self.rejected_commands = 0  # commands with a wrong token
        self._view(fleet.own)

    @property
    def events(self) -> EventHub:
        """Event streams of the page's own robot."""
        return self._view(self._fleet.own).events

    @property
    def viewers(self) -> int:
        """Number of open event streams of all robots."""
        return sum(len(view.events) for view in list(self._views.values()))

    def start(self, bind: str, port: int, tls: ssl.SSLContext | None) -> int:
        """Start listening; return the port (a free one if `port` is 0).

        Raises:
            OSError: the port is in use, or `bind` is no address of this machine.
        """
        self._thread.start()
        return asyncio.run_coroutine_threadsafe(self._open(bind, port, tls), self._loop).result()

    async def _open(self, bind: str, port: int, tls: ssl.SSLContext | None) -> int:
        app = web.Application(middlewares=[self._guard], client_max_size=_MAX_BODY_BYTES)
        for prefix in ("", _ROBOT):
            app.router.add_get(f"{prefix}/events", self._stream, allow_head=False)
            app.router.add_get(f"{prefix}/status", self._get_status)
            app.router.add_get(f"{prefix}/picture/{{name}}", self._get_image)
            for path in self._files:
                if not prefix or path not in _OF_FLEET:
                    app.router.add_get(f"{prefix}{path}", self._get_file)
        app.router.add_get("/robots", self._get_robots)
        app.router.add_get("/metrics", self._get_metrics)
        app.router.add_post("/command", self._post_command)
        _http_log.setLevel(logging.DEBUG)  # the filter counts what aiohttp logs at this level
        _http_log.addFilter(self._protocol_errors)
        runner = web.AppRunner(
            app, access_log=None, logger=_http_log, keepalive_timeout=_IDLE_S, lingering_time=_LINGER_S,
            max_headers=_MAX_HEADERS, shutdown_timeout=_CLOSE_S,
        )  # fmt: skip
        await runner.setup()
        assert runner.server is not None  # set by setup()
        self._runner = runner
        self._listener = Listener(runner.server, tls)
        chosen = await self._listener.listen(bind, port)
        self._publishing = asyncio.create_task(self._publish_periodically())
        return chosen

    def check(self) -> None:
        """Raise the exception that ended the event task, if any; without it, the page is outdated."""
        if self._publishing is not None and self._publishing.done() and not self._publishing.cancelled():
            self._publishing.result()

    def refused(self) -> dict[str, int]:
        """Return how many requests and connections were refused since the start, by reason."""
        replaced = 0 if self._listener is None else self._listener.replaced
        return {
            "commands rejected for a wrong token": self.rejected_commands,
            "requests were not HTTP": self._protocol_errors.count,
            "connections closed because too many were open": replaced,
        }

    def close(self) -> None:
        """Close all connections and end the thread."""
        if self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._close_all(), self._loop).result()
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
        self._encoder.shutdown(wait=False, cancel_futures=True)
        self._command_executor.shutdown(wait=False, cancel_futures=True)

    async def _close_all(self) -> None:
        if self._listener is not None:
            await self._listener.close()
        if self._runner is not None:
            await self._runner.cleanup()
            _http_log.removeFilter(self._protocol_errors)
        if self._publishing is not None:
            self._publishing.cancel()

    # --- robots ---

    def _view(self, robot: str) -> RobotView:
        """Return the view of a robot. Raises RefusedRequest if the page does not know it."""
        state = self._fleet.states().get(robot)
        if state is None:
            raise RefusedRequest(HTTPStatus.NOT_FOUND, "no robot with this name is known: see /robots")
        view = self._views.get(robot)
        if view is None or view.state is not state:  # new, or forgotten and heard again
            view = self._views[robot] = RobotView(state, partial(self._facts, robot), self._encoder)
        return view

    def _view_of(self, request: web.Request) -> RobotView:
        return self._view(request.match_info.get("robot", self._fleet.own))

    def _facts(self, robot: str, view: RobotView) -> dict[str, Any]:
        own = robot == self._fleet.own
        page = {
            "robot": robot, "viewers": len(view.events), "overtaken": view.events.dropped,
            "commands": own and bool(self._access.token), "robots": len(self._fleet.states()),
        }  # fmt: skip
        return {"page": page, "alerts": [alert.as_json() for alert in self._alerting.alerts(robot)]}

    async def _publish_periodically(self) -> None:
        """Publish the robots' poses at `robot_hz` and other events once per second, to open pages."""
        while True:
            await asyncio.sleep(1.0 / self._robot_hz)
            known = self._fleet.states()
            self._views = {name: v for name, v in self._views.items() if name in known or v.events}
            for view in list(self._views.values()):
                if view.events:
                    view.publish(self._loop.time())
                    await view.encode_due_images()

    # --- requests ---

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Check a request, answer it, and send the response within a time limit."""
        connection = request.protocol
        assert self._listener is not None  # requests arrive through it
        self._listener.busy.add(connection)
        try:
            response = await self._answer(request, handler)
            with _aborting(request):
                async with asyncio.timeout(_TRANSFER_S):
                    await response.prepare(request)
                    await response.write_eof()
            return response
        finally:
            self._listener.busy.discard(connection)

    async def _answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        try:
            self._check_source(request)
            response = await handler(request)
        except web.HTTPException as error:  # raised by aiohttp: no such path, method, or a too long body
            response = _json_response({"error": error.reason}, error.status)
        except RefusedRequest as error:
            response = _json_response({"error": str(error)}, error.status)
        if not response.prepared:
            response.headers.update(_HEADERS)
        return response

    def _check_source(self, request: web.Request) -> None:
        """Refuse requests under foreign host names and from pages of other origins, and long bodies."""
        host = request.headers.get("Host", "")
        if not self._access.is_own_host(host):
            raise RefusedRequest(
                HTTPStatus.MISDIRECTED_REQUEST, "unknown host name: add it to the option `names`"
            )
        origin = request.headers.get("Origin")
        if origin is not None and not self._access.is_own_origin(origin, host):
            raise RefusedRequest(
                HTTPStatus.FORBIDDEN, "request of another page: add its host name to the option `names`"
            )
        if (request.content_length or 0) > _MAX_BODY_BYTES:
            raise RefusedRequest(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"more than {_MAX_BODY_BYTES} bytes")

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        view = self._view_of(request)
        if self.viewers >= _MAX_VIEWERS:
            raise RefusedRequest(*_BUSY)
        response = web.StreamResponse(headers={**_HEADERS, "Content-Type": "text/event-stream"})
        viewer = view.events.subscribe()
        try:
            with _aborting(request):
                await response.prepare(request)
                view.publish(None)
                for name in view.state.images:
                    view.publish_image(name)
                while True:
                    data = await viewer.next_events(_HEARTBEAT_S) or _HEARTBEAT
                    async with asyncio.timeout(_TRANSFER_S):
                        await response.write(data)
                        await request.writer.drain()
        finally:
            view.events.unsubscribe(viewer)
        return response

    async def _get_status(self, request: web.Request) -> web.Response:
        return _json_response(self._view_of(request).status())

    async def _get_robots(self, request: web.Request) -> web.Response:
        robots = [
            {
                "name": name, "own": name == self._fleet.own, **state.summary(),
                "alerts": [alert.as_json() for alert in self._alerting.alerts(name)],
            }
            for name, state in self._fleet.states().items()
        ]  # fmt: skip
        return _json_response({"robots": robots})

    async def _get_metrics(self, request: web.Request) -> web.Response:
        body = page_metrics(self._fleet, self._alerting, self.viewers, self.refused())
        return web.Response(body=body, headers={"Content-Type": CONTENT_TYPE})

    async def _get_file(self, request: web.Request) -> web.Response:
        path = request.path
        if (robot := request.match_info.get("robot")) is not None:
            self._view(robot)
            path = path.removeprefix(f"/robots/{robot}")
        body, kind = self._files[path]
        return web.Response(body=body, headers={"Content-Type": kind})

    async def _get_image(self, request: web.Request) -> web.Response:
        view, name = self._view_of(request), request.match_info["name"]
        if name not in view.state.images:
            raise RefusedRequest(HTTPStatus.NOT_FOUND, "not found")
        await view.encode_if_due(name)
        encoded = view.state.images[name].encoded
        if encoded is None:
            raise RefusedRequest(HTTPStatus.NOT_FOUND, f"no {name} yet")
        return web.Response(body=encoded.data, content_type=encoded.content_type)

    # --- commands ---

    async def _post_command(self, request: web.Request) -> web.Response:
        """Execute the command in a request of an authorized user."""
        await self._check_token(request)
        try:
            async with asyncio.timeout(_TRANSFER_S):
                command = json.loads(await request.read())
            action, node = str(command["action"]), str(command.get("node", ""))
            parameters = {str(k): str(v) for k, v in command.get("parameters", {}).items()}
        except (TimeoutError, ConnectionError, web.RequestPayloadError) as error:
            raise RefusedRequest(HTTPStatus.REQUEST_TIMEOUT, "the request is not complete") from error
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise RefusedRequest(
                HTTPStatus.BAD_REQUEST, 'not a command: send {"action": ..., "node": ...}'
            ) from error
        if self._commands >= _MAX_COMMANDS:
            raise RefusedRequest(*_BUSY)
        self._commands += 1
        try:
            done = await self._loop.run_in_executor(
                self._command_executor, self._command, action, node, parameters
            )
        except ValueError as error:
            raise RefusedRequest(HTTPStatus.CONFLICT, str(error)) from error
        finally:
            self._commands -= 1
        return _json_response({"text": done})

    async def _check_token(self, request: web.Request) -> None:
        if not self._access.token:
            raise RefusedRequest(
                HTTPStatus.FORBIDDEN, "commands are disabled: the page's option `token` is empty"
            )
        if not self._access.is_token(request.headers.get("Authorization", "").removeprefix("Bearer ")):
            self.rejected_commands += 1
            await asyncio.sleep(_WRONG_TOKEN_DELAY_S)
            raise RefusedRequest(HTTPStatus.UNAUTHORIZED, "wrong token: see the page's option `token`")


@contextlib.contextmanager
def _aborting(request: web.Request) -> Iterator[None]:
    """Close the connection at once if the client does not read in time, or has closed it."""
    try:
        yield
    except (TimeoutError, ConnectionError):
        if request.transport is not None:
            request.transport.abort()


def _json_response(data: dict[str, Any], status: int = HTTPStatus.OK) -> web.Response:
    return web.Response(body=as_json(data), status=status, content_type="application/json")
