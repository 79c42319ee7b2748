"""A server of the routes that the 3D viewer uses, whose map, robot and faults a test controls.

The files are those of the page, with its security headers.
"""

import json
import queue
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np

from beamsplat.common.mapfiles.detail import merge_by_cell
from beamsplat.common.messages.splat_codec import pack
from beamsplat.common.raster.layout import MEAN, SCALE
from beamsplat.services.page.responses import HEADERS
from tests.web.scene import CAMERA

STATIC = Path(__file__).resolve().parents[2] / "services" / "page" / "static"
_FILES = {"/": "index.html", "/view": "viewer.html"}
_KINDS = {".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".css": "text/css", ".svg": "image/svg+xml", ".txt": "text/plain"}  # fmt: skip


class MapServer:
    """HTTP server in threads; use it as a context manager."""

    def __init__(self, port=0, producer="first"):
        self.producer, self.revision, self.note = producer, 0, ""
        self.chunks = {}  # anchor -> (revision, T_map_anchor, {cell_m: (count, bytes)}, low, high)
        self.keyframes = {}  # id -> (T_map_camera, image uint8 [H, W, 3] RGB)
        self.hidden = set()  # paths that are not found
        self.asked = []
        self._streams = []
        self._lock = threading.Lock()
        server = self

        class Handler(BaseHTTPRequestHandler):  # HTTP/1.0: no connection outlives the server
            def do_GET(self):
                server._answer(self)

            def log_message(self, *_):
                pass

        class Server(ThreadingHTTPServer):
            daemon_threads = True
            allow_reuse_address = True

            def handle_error(self, *_):  # the browser goes away in the middle
                pass

        self._http = Server(("127.0.0.1", port), Handler)
        self.port = self._http.server_address[1]
        self.address = f"http://127.0.0.1:{self.port}/"
        threading.Thread(target=self._http.serve_forever, daemon=True).start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """End all event streams, and stop listening."""
        with self._lock:
            streams, self._streams = self._streams, []
        for stream in streams:
            stream.put(None)
        self._http.shutdown()
        self._http.server_close()

    def put(self, anchor, params, T_map_anchor=None, cells_m=(0.0, 0.08)):
        """Add or replace a chunk [14, N] (anchor frame), and tell the viewers."""
        levels = {}
        for cell_m in cells_m:
            merged = merge_by_cell(params, cell_m)
            levels[cell_m] = merged.shape[1], pack(merged).tobytes()
        means = params[MEAN:SCALE]
        before = self.chunks.get(anchor, (0,))[0]
        pose = np.eye(4) if T_map_anchor is None else T_map_anchor
        self.chunks[anchor] = before + 1, pose, levels, means.min(axis=1), means.max(axis=1)
        self._changed()

    def remove(self, anchor):
        """Remove a chunk, and tell the viewers."""
        del self.chunks[anchor]
        self._changed()

    def _changed(self):
        self.revision += 1
        self.publish("map3d", {"producer": self.producer, "revision": self.revision})

    def publish(self, kind, data):
        """Send an event to all open streams."""
        with self._lock:
            for stream in self._streams:
                stream.put(f"event: {kind}\ndata: {json.dumps(data)}\n\n".encode())

    def robot(self, x_m, y_m, yaw_rad):
        """Publish the robot's pose."""
        self.publish(
            "robot",
            {
                "x_m": x_m,
                "y_m": y_m,
                "yaw_rad": yaw_rad,
                "source": "localization",
                "age_s": 0.0,
                "scan_cm": [],
            },
        )

    def index(self):
        """Return the index of the map."""
        return {
            "producer": self.producer, "revision": self.revision, "editable": False, "saved": False, "note": self.note,
            "limited": {"coarsened": 0, "left_out": 0, "budget_mb": 100},
            "chunks": [
                {
                    "anchor": anchor, "revision": revision, "T_map_anchor": T.ravel().tolist(), "low": low.tolist(),
                    "high": high.tolist(),
                    "levels": [{"cell_m": c, "count": n, "bytes": len(b)} for c, (n, b) in levels.items()],
                }
                for anchor, (revision, T, levels, low, high) in self.chunks.items()
            ],
            "keyframes": [{"id": str(k), "T_map_camera": T.ravel().tolist()} for k, (T, _) in self.keyframes.items()],
            "camera": {
                "width": CAMERA.width_px, "height": CAMERA.height_px,
                "K": [CAMERA.fx_px, 0.0, CAMERA.cx_px, 0.0, CAMERA.fy_px, CAMERA.cy_px, 0.0, 0.0, 1.0],
            },
        }  # fmt: skip

    def _answer(self, request):
        url = urlsplit(request.path)
        self.asked.append(request.path)
        query = {name: values[0] for name, values in parse_qs(url.query).items()}
        if url.path in self.hidden:
            _send(request, 404, b'{"error": "not found"}', "application/json")
        elif url.path == "/events":
            self._stream(request)
        elif url.path == "/map3d":
            _send(request, 200, json.dumps(self.index()).encode(), "application/json")
        elif url.path.startswith("/map3d/chunk/"):
            self._chunk(request, int(url.path.rsplit("/", 1)[1]), query)
        elif url.path.startswith("/map3d/keyframe/"):
            _, image = self.keyframes[int(url.path.rsplit("/", 1)[1])]
            if "width" in query:
                image = cv2.resize(image, (int(query["width"]), 120))
            _send(request, 200, cv2.imencode(".png", image[..., ::-1])[1].tobytes(), "image/png")
        else:
            path = STATIC / _FILES.get(url.path, url.path.removeprefix("/"))
            if path.is_file():
                _send(request, 200, path.read_bytes(), _KINDS[path.suffix])
            else:
                _send(request, 404, b'{"error": "not found"}', "application/json")

    def _chunk(self, request, anchor, query):
        chunk = self.chunks.get(anchor)
        if chunk is None or query["producer"] != self.producer or int(query["revision"]) != chunk[0]:
            _send(request, 404, b'{"error": "gone"}', "application/json")
        else:
            _send(request, 200, chunk[2][float(query["cell_m"])][1], "application/octet-stream")

    def _stream(self, request):
        waiting = queue.Queue()
        with self._lock:
            self._streams.append(waiting)
        request.send_response(200)
        for name, value in (HEADERS | {"Content-Type": "text/event-stream", "Connection": "close"}).items():
            request.send_header(name, value)
        request.end_headers()
        request.wfile.write(b": open\n\n")
        while (event := waiting.get()) is not None:
            request.wfile.write(event)
        request.close_connection = True


def _send(request, status, body, kind):
    request.send_response(status)
    for name, value in (HEADERS | {"Content-Type": kind, "Content-Length": str(len(body))}).items():
        request.send_header(name, value)
    request.end_headers()
    request.wfile.write(body)
