"""Requests for the 3D map. All is encoded once for all viewers; chunks never change under their address.

GET /map3d                       index: chunks with their levels of detail, keyframes, camera
GET /map3d/chunk/ANCHOR          ?producer=P&revision=R&cell_m=C: packed Gaussians (`splat_codec`)
GET /map3d/keyframe/ID           ?width=W: image of a keyframe, JPEG
GET /map3d/render                ?T=16 numbers&width=W&height=H&focal_px=F: the map from a pose, JPEG
"""

from __future__ import annotations

import asyncio
import gzip
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus

import numpy as np
from aiohttp import web

from beamsplat.common.geometry.limits import FOCAL_RATIO
from beamsplat.services.page.events import as_json
from beamsplat.services.page.map3d.source import MapSource, MapUnavailable, ViewRequest
from beamsplat.services.page.responses import BUSY, RefusedRequest

_IMMUTABLE = {"Cache-Control": "private, max-age=86400, immutable"}
_MAX_WAITING_IMAGES = 32  # requests for images of keyframes; renders are made one at a time
_SIZE_PX = (16, 1280)  # of a render
_LARGEST_M = 1e6
_ROTATION_TOLERANCE = 1e-3


class Map3dRoutes:
    """Handlers of the requests for the 3D maps of a page; call `close` at the end."""

    def __init__(self, source_of: Callable[[web.Request], MapSource]) -> None:
        """Create the handlers.

        Args:
            source_of: returns the map that a request asks for; raises RefusedRequest if there is none.
        """
        self._source_of = source_of
        self._images = ThreadPoolExecutor(1, "page-keyframe")
        self._renders = ThreadPoolExecutor(1, "page-render")
        self._waiting_images = self._waiting_renders = 0
        self._indices: dict[MapSource, tuple[str, int, bytes, bytes]] = {}  # producer, revision, JSON, gzip

    def add(self, router: web.UrlDispatcher, prefix: str) -> None:
        """Add the routes below a prefix."""
        router.add_get(f"{prefix}/map3d", self._get_index)
        router.add_get(f"{prefix}/map3d/chunk/{{anchor}}", self._get_chunk)
        router.add_get(f"{prefix}/map3d/keyframe/{{id}}", self._get_keyframe)
        router.add_get(f"{prefix}/map3d/render", self._get_render)

    def close(self) -> None:
        """Discard the requests that have not begun."""
        for executor in (self._images, self._renders):
            executor.shutdown(wait=False, cancel_futures=True)

    async def _get_index(self, request: web.Request) -> web.Response:
        source = self._source_of(request)
        source.want()
        state = source.map.producer, source.map.revision
        known = self._indices.get(source)
        if known is None or known[:2] != state:
            body = as_json(source.index())
            known = self._indices[source] = (*state, body, gzip.compress(body, 1))
            self._indices = {s: i for s, i in self._indices.items() if s is source or s.active or s.saved}
        headers = {"Content-Type": "application/json"}
        if "gzip" in request.headers.get("Accept-Encoding", ""):
            return web.Response(body=known[3], headers={**headers, "Content-Encoding": "gzip"})
        return web.Response(body=known[2], headers=headers)

    async def _get_chunk(self, request: web.Request) -> web.Response:
        source = self._source_of(request)
        source.want()
        producer = request.query.get("producer")
        try:
            anchor = int(request.match_info["anchor"])
            revision, cell_m = int(request.query["revision"]), float(request.query["cell_m"])
        except (KeyError, ValueError):
            raise RefusedRequest(
                HTTPStatus.NOT_FOUND, "no such chunk: give ANCHOR, revision and cell_m as /map3d lists them"
            ) from None
        packed = None
        if producer in (None, source.map.producer):
            packed = source.map.level(anchor, revision, cell_m)
        if packed is None:
            raise RefusedRequest(
                HTTPStatus.NOT_FOUND, f"revision {revision} of chunk {anchor} is gone: ask for /map3d again"
            )
        headers = {"Content-Type": "application/octet-stream"}
        # Without the producer the address may mean another map after a restart.
        return web.Response(body=packed, headers=headers if producer is None else {**headers, **_IMMUTABLE})

    async def _get_keyframe(self, request: web.Request) -> web.Response:
        source = self._source_of(request)
        source.want()
        try:
            id, width_px = int(request.match_info["id"]), int(request.query.get("width", "0"))
        except ValueError:
            raise RefusedRequest(HTTPStatus.NOT_FOUND, "no such keyframe: ID and width are numbers") from None
        if self._waiting_images >= _MAX_WAITING_IMAGES:
            raise RefusedRequest(*BUSY)
        self._waiting_images += 1
        try:
            image = await self._run(self._images, source.keyframe, id, max(width_px, 0))
        finally:
            self._waiting_images -= 1
        # Its id always has the same image, and ids are times: no other map has it.
        return web.Response(body=image, headers={"Content-Type": "image/jpeg", **_IMMUTABLE})

    async def _get_render(self, request: web.Request) -> web.Response:
        source = self._source_of(request)
        source.want()
        view = _view(request)
        if self._waiting_renders:
            raise RefusedRequest(HTTPStatus.SERVICE_UNAVAILABLE, "busy with another render: try again")
        self._waiting_renders += 1
        try:
            image = await self._run(self._renders, source.render, view)
        finally:
            self._waiting_renders -= 1
        return web.Response(body=image, content_type="image/jpeg")

    async def _run(
        self, executor: ThreadPoolExecutor, work: Callable[..., bytes], *arguments: object
    ) -> bytes:
        try:
            return await asyncio.get_running_loop().run_in_executor(executor, work, *arguments)
        except MapUnavailable as error:
            raise RefusedRequest(error.status, str(error)) from error


def _view(request: web.Request) -> ViewRequest:
    """Return the view in the parameters of a request.

    Raises:
        RefusedRequest: a parameter is missing or out of range; the text names it.
    """
    words = request.query.get("T", "").split(",")
    try:
        T = np.array([float(word) for word in words]).reshape(4, 4)
    except ValueError:
        raise _wrong("T", "16 numbers, T_map_camera row by row") from None
    R = T[:3, :3]
    rigid = np.isfinite(T).all() and np.abs(T[:3, 3]).max() < _LARGEST_M
    rigid = rigid and np.abs(R @ R.T - np.eye(3)).max() < _ROTATION_TOLERANCE and np.linalg.det(R) > 0.0
    if not rigid or np.abs(T[3] - (0.0, 0.0, 0.0, 1.0)).max() > _ROTATION_TOLERANCE:
        raise _wrong("T", "a rotation and a translation")
    width, height = (int(_number(request, name, _SIZE_PX)) for name in ("width", "height"))
    limits = tuple(ratio * max(width, height) for ratio in FOCAL_RATIO)
    return ViewRequest(T, width, height, _number(request, "focal_px", (limits[0], limits[1])))


def _number(request: web.Request, name: str, limits: tuple[float, float]) -> float:
    try:
        value = float(request.query.get(name, ""))
    except ValueError:
        value = math.nan
    if not limits[0] <= value <= limits[1]:
        raise _wrong(name, f"a number from {limits[0]:g} to {limits[1]:g}")
    return value


def _wrong(name: str, expected: str) -> RefusedRequest:
    return RefusedRequest(HTTPStatus.BAD_REQUEST, f"render: {name}: expected {expected}")
