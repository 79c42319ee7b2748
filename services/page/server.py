"""The page's HTTP server, in its own thread: the node never waits for a browser.

GET /                     the page; its parts are /page.js, /page.css ...
GET /events               server-sent events: status, scale, path, robot, picture (there is a newer image),
                          map3d (the map has changed); with ?scan=1, for viewers of the map, also scan3d
GET /picture/NAME         the newest image: camera, depth, render or map
GET /status               the data of the status event, for scripts
GET /map3d, /map3d/...    the 3D map: see `map3d.routes`; /view is a page for it alone, /viewer/... its parts
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
import logging
import ssl
import threading
from collections.abc import Awaitable, Callable
from http import HTTPStatus

from aiohttp import web

from beamsplat.services.page.access import PageAccess
from beamsplat.services.page.alerting import Alerting
from beamsplat.services.page.command_requests import Command, CommandRequests
from beamsplat.services.page.events import EventHub
from beamsplat.services.page.fleet import Fleet
from beamsplat.services.page.listener import MAX_CONNECTIONS, Listener
from beamsplat.services.page.map3d.routes import Map3dRoutes
from beamsplat.services.page.map3d.source import MapSource
from beamsplat.services.page.metrics import CONTENT_TYPE, page_metrics
from beamsplat.services.page.responses import (
    BUSY,
    HEADERS,
    TRANSFER_S,
    ProtocolErrors,
    RefusedRequest,
    aborting,
    json_response,
)
from beamsplat.services.page.robot_view import RobotView
from beamsplat.services.page.robot_views import MapMaker, RobotViews
from beamsplat.services.page.static_files import OF_FLEET, read_files, read_viewer

_http_log = logging.getLogger(f"{__name__}.http")
_ROBOT = "/robots/{robot}"
_MAX_VIEWERS = MAX_CONNECTIONS // 2  # open event streams: the other connections remain for requests
_MAX_HEADERS = 64  # of a request, each of at most 8 kB (aiohttp's default)
_MAX_BODY_BYTES = 16 * 1024
_IDLE_S = 20.0  # a connection without a complete request is closed
_HEARTBEAT_S = 15.0  # after so long without an event, a comment shows whether the page still reads
_HEARTBEAT = b":\n\n"
_LINGER_S = 2.0  # for the rest of a refused request, so that the client reads the response
_CLOSE_S = 0.1  # for requests in progress when the server is closed

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class PageServer:
    """HTTP server of the robots of a `Fleet`; call `start()`, then `close()`."""

    def __init__(
        self, fleet: Fleet, alerting: Alerting, command: Command, access: PageAccess, robot_hz: float,
        make_map: MapMaker = lambda robot, state: MapSource(), saved: bool = False,
    ) -> None:  # fmt: skip
        """Create the server.

        Args:
            robot_hz: rate of the robots' poses.
            make_map: called once for each robot; the default has no map.
            saved: the page /view shows a map that does not change.
        """
        self._fleet, self._alerting, self._access = fleet, alerting, access
        self._views = RobotViews(fleet, alerting, bool(access.token), make_map)
        self._commands = CommandRequests(command, access)
        self._robot_hz = robot_hz
        self._files, self._viewer = read_files(saved), read_viewer()
        self._map3d = Map3dRoutes(lambda request: self._view_of(request).map3d)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="page", daemon=True)
        self._runner: web.AppRunner | None = None
        self._listener: Listener | None = None
        self._publishing: asyncio.Task[None] | None = None
        self._protocol_errors = ProtocolErrors()
        self._views.of(fleet.own)

    @property
    def rejected_commands(self) -> int:
        """Number of commands with a wrong token."""
        return self._commands.rejected

    @property
    def events(self) -> EventHub:
        """Event streams of the page's own robot."""
        return self._views.of(self._fleet.own).events

    @property
    def viewers(self) -> int:
        """Number of open event streams of all robots."""
        return self._views.viewers

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
            app.router.add_get(f"{prefix}/viewer/{{file}}", self._get_viewer)
            self._map3d.add(app.router, prefix)
            for path in self._files:
                if not prefix or path not in OF_FLEET:
                    app.router.add_get(f"{prefix}{path}", self._get_file)
        app.router.add_get("/robots", self._get_robots)
        app.router.add_get("/metrics", self._get_metrics)
        app.router.add_post("/command", self._commands.handle)
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
            "commands rejected for a wrong token": self._commands.rejected,
            "requests were not HTTP": self._protocol_errors.count,
            "connections closed because too many were open": replaced,
        }

    def reduced_chunks(self) -> dict[str, int]:
        """Return how many chunks of the 3D maps are not shown in full detail, by reason."""
        return self._views.reduced_chunks()

    def close(self) -> None:
        """Close all connections and end the thread."""
        if self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._close_all(), self._loop).result()
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
        self._commands.close()
        self._map3d.close()
        self._views.close()

    async def _close_all(self) -> None:
        if self._listener is not None:
            await self._listener.close()
        if self._runner is not None:
            await self._runner.cleanup()
            _http_log.removeFilter(self._protocol_errors)
        if self._publishing is not None:
            self._publishing.cancel()

    def _view_of(self, request: web.Request) -> RobotView:
        return self._views.of(request.match_info.get("robot", self._fleet.own))

    async def _publish_periodically(self) -> None:
        """Publish the robots' poses at `robot_hz` and other events once per second, to open pages."""
        while True:
            await asyncio.sleep(1.0 / self._robot_hz)
            for view in self._views.with_viewers():
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
            with aborting(request):
                async with asyncio.timeout(TRANSFER_S):
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
            response = json_response({"error": error.reason}, error.status)
        except RefusedRequest as error:
            response = json_response({"error": str(error)}, error.status)
        if not response.prepared:
            for name, value in HEADERS.items():
                response.headers.setdefault(name, value)
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
            raise RefusedRequest(*BUSY)
        response = web.StreamResponse(headers={**HEADERS, "Content-Type": "text/event-stream"})
        viewer = view.events.subscribe(wants_scan=request.query.get("scan") == "1")
        try:
            with aborting(request):
                await response.prepare(request)
                view.publish(None)
                for name in view.state.images:
                    view.publish_image(name)
                while True:
                    data = await viewer.next_events(_HEARTBEAT_S) or _HEARTBEAT
                    async with asyncio.timeout(TRANSFER_S):
                        await response.write(data)
                        await request.writer.drain()
        finally:
            view.events.unsubscribe(viewer)
        return response

    async def _get_status(self, request: web.Request) -> web.Response:
        return json_response(self._view_of(request).status())

    async def _get_robots(self, request: web.Request) -> web.Response:
        robots = [
            {
                "name": name, "own": name == self._fleet.own, **state.summary(),
                "alerts": [alert.as_json() for alert in self._alerting.alerts(name)],
            }
            for name, state in self._fleet.states().items()
        ]  # fmt: skip
        return json_response({"robots": robots})

    async def _get_metrics(self, request: web.Request) -> web.Response:
        body = page_metrics(self._fleet, self._alerting, self.viewers, self.refused())
        return web.Response(body=body, headers={"Content-Type": CONTENT_TYPE})

    async def _get_file(self, request: web.Request) -> web.Response:
        path = request.path
        if (robot := request.match_info.get("robot")) is not None:
            self._views.of(robot)
            path = path.removeprefix(f"/robots/{robot}")
        body, kind = self._files[path]
        return web.Response(body=body, headers={"Content-Type": kind})

    async def _get_viewer(self, request: web.Request) -> web.StreamResponse:
        self._view_of(request)
        file = self._viewer.get(request.match_info["file"])
        if file is None:
            raise RefusedRequest(HTTPStatus.NOT_FOUND, "not found: `make web` builds the 3D viewer")
        headers = {"Content-Type": file.kind, "ETag": file.tag, "Cache-Control": "no-cache"}
        if request.headers.get("If-None-Match") == file.tag:
            return web.Response(status=HTTPStatus.NOT_MODIFIED, headers=headers)
        return web.Response(body=file.body, headers=headers)

    async def _get_image(self, request: web.Request) -> web.Response:
        view, name = self._view_of(request), request.match_info["name"]
        if name not in view.state.images:
            raise RefusedRequest(HTTPStatus.NOT_FOUND, "not found")
        await view.encode_if_due(name)
        encoded = view.state.images[name].encoded
        if encoded is None:
            raise RefusedRequest(HTTPStatus.NOT_FOUND, f"no {name} yet")
        return web.Response(body=encoded.data, content_type=encoded.content_type)
