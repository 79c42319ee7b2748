"""A minimal HTTP/1.1 server: short requests and responses, with limits on sizes and times.

The standard library's server needs one thread per connection, too many if ten phones show the page.
"""

from __future__ import annotations

import asyncio
import ipaddress
import socket
from dataclasses import dataclass
from http import HTTPStatus

MAX_HEAD_BYTES = 16 * 1024
MAX_BODY_BYTES = 16 * 1024
IDLE_S = 60.0  # a connection without a request is closed
# No content from other origins, no inline scripts, no embedding in frames, no content sniffing.
SECURITY_HEADERS = (
    b"Content-Security-Policy: default-src 'self'; frame-ancestors 'none'; base-uri 'none'\r\n"
    b"X-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n"
    b"Cross-Origin-Resource-Policy: same-origin\r\n"
)


class HttpError(ValueError):
    """Error: a request that is answered with an error status."""

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


@dataclass(frozen=True)
class HttpRequest:
    """One HTTP request; header names are in lower case."""

    method: str
    path: str  # without the query string
    headers: dict[str, str]
    body: bytes


async def read_request(reader: asyncio.StreamReader) -> HttpRequest | None:
    """Return the next request of a connection; None if the connection ends or is idle for `IDLE_S`.

    Raises:
        HttpError: not an HTTP/1 request, or too long.
    """
    try:
        async with asyncio.timeout(IDLE_S):
            head = await reader.readuntil(b"\r\n\r\n")
            request = _parse(head)
            size = _body_bytes(request.headers)
            if size:
                request = HttpRequest(
                    request.method, request.path, request.headers, await reader.readexactly(size)
                )
            return request
    except asyncio.LimitOverrunError as error:
        raise HttpError(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, "request header too long") from error
    except (asyncio.IncompleteReadError, TimeoutError, ConnectionError):
        return None


def _parse(head: bytes) -> HttpRequest:
    first, *lines = head.decode("latin-1").split("\r\n")
    parts = first.split(" ")
    if len(parts) != 3 or not parts[2].startswith("HTTP/1."):
        raise HttpError(HTTPStatus.BAD_REQUEST, "not an HTTP/1 request")
    headers = {}
    for line in lines:
        name, colon, value = line.partition(":")
        if colon:
            headers[name.strip().lower()] = value.strip()
    return HttpRequest(parts[0], parts[1].partition("?")[0], headers, b"")


def _body_bytes(headers: dict[str, str]) -> int:
    if "transfer-encoding" in headers:
        raise HttpError(HTTPStatus.LENGTH_REQUIRED, "Content-Length is required")
    text = headers.get("content-length", "0")
    if not (text.isascii() and text.isdigit()):
        raise HttpError(HTTPStatus.BAD_REQUEST, "invalid Content-Length")
    if len(text) > 9 or int(text) > MAX_BODY_BYTES:
        raise HttpError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"more than {MAX_BODY_BYTES} bytes")
    return int(text)


def make_response(status: HTTPStatus, content_type: str, body: bytes, extra: bytes = b"") -> bytes:
    """Return the bytes of a complete response, marked as not to be stored by caches."""
    return (
        f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: {content_type}\r\n"
        f"Content-Length: {len(body)}\r\nCache-Control: no-store\r\n"
    ).encode() + SECURITY_HEADERS + extra + b"\r\n" + body  # fmt: skip


STREAM_HEAD = (
    b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nCache-Control: no-store\r\n"
    + SECURITY_HEADERS + b"Connection: close\r\n\r\n"
)  # fmt: skip


def is_own_host(host: str, own: frozenset[str]) -> bool:
    """Return whether a Host header is a name of this machine: an IP address, localhost, or one of `own`.

    A foreign page can let its own host name refer to this machine (DNS rebinding) to read the data of this
    server. The browser then sends that foreign name in the Host header, which the page cannot change.
    """
    name = host.strip().lower()
    if name.startswith("["):
        name = name[1:].partition("]")[0]
    elif name.count(":") <= 1:
        name = name.partition(":")[0]
    if name in own:
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def own_host_names() -> frozenset[str]:
    """Return the host names by which browsers may address this machine."""
    host = socket.gethostname().lower()
    return frozenset({"localhost", host, f"{host}.local", socket.getfqdn().lower()})
