"""Server of rerun's web viewer, and choice of its ports."""

from __future__ import annotations

import socket
from urllib.parse import quote

import rerun as rr


def free_port(bind: str, port: int) -> int:
    """Return `port`; if it is 0, return a free port.

    Raises:
        OSError: the port is in use, or `bind` is no address of this machine.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((bind, port))
        return probe.getsockname()[1]


def serve_page(bind: str, web_port: int, grpc_port: int) -> str:
    """Serve the web viewer on `web_port` of all network interfaces; return the address to open in a browser.

    This port serves only the viewer program, which loads the data from `grpc_port` at `bind`.

    Raises:
        RuntimeError: the port is in use.
    """
    rr.serve_web_viewer(web_port=web_port, open_browser=False)
    host = socket.gethostname() if bind == "0.0.0.0" else bind
    data = quote(f"rerun+http://{host}:{grpc_port}/proxy", safe="")
    return f"http://{host}:{web_port}/?url={data}"


def allowed_origins(bind: str, web_port: int) -> list[str]:
    """Return the origins (CORS) of other machines whose pages may read the data."""
    return [] if bind == "127.0.0.1" else [f"http://*:{web_port}"]
