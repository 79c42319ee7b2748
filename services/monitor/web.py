"""The page on which a browser sees the running system, and the ports it takes."""

from __future__ import annotations

import socket
from urllib.parse import quote

import rerun as rr


def free_port(bind: str, port: int) -> int:
    """`port`, or a free one for 0.

    Raises:
        OSError: the port is taken, or `bind` is no address of this machine.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((bind, port))
        return probe.getsockname()[1]


def serve_page(bind: str, web_port: int, grpc_port: int) -> str:
    """Serves the web viewer at `web_port` of all interfaces (the program alone: the data come from
    `grpc_port`, at `bind`); returns the address to open.

    Raises:
        RuntimeError: the port is taken.
    """
    rr.serve_web_viewer(web_port=web_port, open_browser=False)
    host = socket.gethostname() if bind == "0.0.0.0" else bind
    data = quote(f"rerun+http://{host}:{grpc_port}/proxy", safe="")
    return f"http://{host}:{web_port}/?url={data}"


def allowed_origins(bind: str, web_port: int) -> list[str]:
    """The pages that may read the data, besides those of this machine."""
    return [] if bind == "127.0.0.1" else [f"http://*:{web_port}"]
