"""Answers of the page's server: headers of every response, refused requests, and slow clients."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from beamsplat.services.page.events import as_json

# Of responses that set no other values: no content from other origins, no inline scripts, no embedding in
# frames, no content sniffing, no caching.
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Server": "beamsplat",
}
TRANSFER_S = 20.0  # a connection whose request body or response takes longer is closed
BUSY = (HTTPStatus.SERVICE_UNAVAILABLE, "too many requests at the same time: try again")


class RefusedRequest(Exception):
    """Error: a request that is answered with an error status and a text."""

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


class ProtocolErrors(logging.Filter):
    """Counts requests that are not HTTP, in place of a traceback in the log for each."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def filter(self, record: logging.LogRecord) -> bool:
        """Drop and count the record of an invalid request; keep all others."""
        if record.exc_info and isinstance(record.exc_info[1], HttpProcessingError):
            self.count += 1
            return False
        return True


@contextlib.contextmanager
def aborting(request: web.Request) -> Iterator[None]:
    """Close the connection at once if the client does not read in time, or has closed it."""
    try:
        yield
    except (TimeoutError, ConnectionError):
        if request.transport is not None:
            request.transport.abort()


def json_response(data: dict[str, Any], status: int = HTTPStatus.OK) -> web.Response:
    """Return a response with data as JSON."""
    return web.Response(body=as_json(data), status=status, content_type="application/json")
