"""The page's server alone: encoding cost, slow clients, invalid requests."""

import http.client
import json
import math
import socket
import ssl
import threading
import time
import urllib.request

import cv2
import numpy as np
import pytest

from beamsplat.common.config.alerts import AlertConfig
from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.mapfiles.grid_tiles import GridSource, TiledGrid, pack_tile
from beamsplat.common.messages import FusedDepth, Health
from beamsplat.common.runtime.registry import make_node
from beamsplat.common.security.access_control import HostRole
from beamsplat.common.security.keys import CA, CERTIFICATE, KEY
from beamsplat.services.nodes import NODES
from beamsplat.services.page.access import PageAccess
from beamsplat.services.page.alerting import Alerting
from beamsplat.services.page.fleet import Fleet
from beamsplat.services.page.images import (
    EncodedImage,
    LatestImage,
    encode_camera_image,
    encode_depth,
    encode_grid,
    encode_tiles,
)
from beamsplat.services.page.node import PageConfig, PageNode
from beamsplat.services.page.server import PageServer
from beamsplat.services.page.view import PageState
from beamsplat.tools.keys.pki import CertificateAuthority

TOKEN = "correct horse battery"


class Serving:
    """A running server whose state a test sets."""

    def __init__(self, picture_hz=20.0, robot_hz=20.0, tls=None):
        self.fleet = Fleet("r0", lambda: PageState(picture_hz, picture_hz))
        self.fleet.state_of("r1")
        self.state = self.fleet.own_state
        self.orders = []
        self.alerting = Alerting(self.fleet, AlertConfig())
        self.server = PageServer(self.fleet, self.alerting, self._command, PageAccess(TOKEN), robot_hz)
        self.port = self.server.start("127.0.0.1", 0, tls)

    def _command(self, *order):
        self.orders.append(order)
        return "done"

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.server.close()
        self.alerting.close()

    def ask(self, raw):
        """Send raw bytes; return (status, body) of the response."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=10) as s:
            s.sendall(raw)
            reply = http.client.HTTPResponse(s)
            reply.begin()
            return reply.status, reply.read()

    def status(self, raw):
        """Send raw bytes; return the status of the response, also of one that does not end."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=10) as s:
            s.sendall(raw)
            reply = http.client.HTTPResponse(s)
            reply.begin()
            return reply.status

    def get(self, path, host="127.0.0.1"):
        return self.ask(f"GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())

    def open_event_stream(self):
        s = socket.socket()
        s.settimeout(20)
        s.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16 * 1024)
        s.connect(("127.0.0.1", self.port))
        s.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        return s


def _wait(until, timeout_s=20.0):
    deadline = time.monotonic() + timeout_s
    while not until():
        assert time.monotonic() < deadline
        time.sleep(0.01)


class EventReader(threading.Thread):
    """Collects the events of one stream."""

    def __init__(self, viewer):
        super().__init__(daemon=True)
        self.events, self._viewer = [], viewer
        self.start()

    def run(self):
        with self._viewer.makefile("rb") as lines:
            for line in lines:
                if line.startswith(b"data:"):
                    self.events.append(json.loads(line[5:]))


def test_a_page_that_does_not_read_blocks_no_other():
    with Serving() as serving:
        asleep = serving.open_event_stream()
        awake = EventReader(serving.open_event_stream())
        _wait(lambda: len(serving.server.events) == 2)
        rng = np.random.default_rng(0)
        for i in range(600):  # 3 KB each: a megabyte and more that nobody takes
            serving.state.scan(i, rng.uniform(1, 9, 360).astype(np.float32), 0.0, 0.017, (0, 10))
            serving.state.pose("localization", i, se2_to_se3(np.array([i, 0.0, 0.0])))
            time.sleep(0.01)
        _wait(lambda: any(isinstance(e, dict) and e.get("x_m") == 599.0 for e in awake.events))
        slow, fast = sorted(serving.server.events.subscribers, key=lambda v: -v.dropped)
        assert slow.dropped > 20
        assert fast.dropped < 5
        assert len(slow.waiting) <= 4, "the newest of each kind waits, not all"
        asleep.close()
        _wait(lambda: len(serving.server.events) == 1)
        assert serving.server.events.dropped >= slow.dropped


def test_an_image_is_encoded_once_for_all_pages_and_only_if_one_is_open():
    encoded = []

    def encode():
        encoded.append(time.monotonic())
        return EncodedImage(b"picture", "image/jpeg", {})

    with Serving(picture_hz=10.0) as serving:
        for _ in range(20):
            serving.state.images["camera"].update(encode)
            time.sleep(0.01)
        assert encoded == [], "nobody looks"
        readers = [EventReader(serving.open_event_stream()) for _ in range(10)]
        _wait(lambda: all(any("name" in e for e in r.events if isinstance(e, dict)) for r in readers))
        assert len(encoded) == 1
        for _ in range(10):
            assert serving.get("/picture/camera") == (200, b"picture")
        assert len(encoded) == 1, "the same one for ten requests"
        for _ in range(100):
            serving.state.images["camera"].update(encode)
            serving.get("/picture/camera")
            time.sleep(0.005)
        gaps = np.diff(encoded)
        assert len(encoded) > 3
        assert gaps.min() >= 0.1


def test_a_damaged_image_is_reported_and_the_last_valid_one_stays():
    picture = LatestImage(1000.0)
    assert picture.metadata() is None
    good = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].ravel()
    picture.update(lambda: encode_camera_image(good, "jpeg", (8, 8), 0, 4))
    picture.encode_newest()
    shown = picture.encoded
    assert cv2.imdecode(np.frombuffer(shown.data, np.uint8), cv2.IMREAD_COLOR).shape == (4, 4, 3)
    picture.update(lambda: encode_camera_image(good[:20], "jpeg", (8, 8), 0, 4))
    picture.encode_newest()
    assert picture.encoded is shown
    assert "do not decode as jpeg" in picture.fault
    assert picture.metadata() == {"number": 2}


@pytest.mark.parametrize(
    ("raw", "status"),
    [
        (b"rubbish\r\n\r\n", 400),
        (b"GET / SPDY/3\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 40_000 + b"\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"X: 1\r\n" * 100 + b"\r\n", 400),
        (b"POST /command HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99999\r\n\r\n", 413),
        (b"POST /command HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n", 400),
        (b"POST /command HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: x\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n", 421),
        (b"GET /events HTTP/1.1\r\nHost: evil.example:80\r\n\r\n", 421),
        (b"GET / HTTP/1.1\r\n\r\n", 400),
        (b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n", 405),
        (b"GET /../node.py HTTP/1.1\r\nHost: localhost\r\n\r\n", 404),
        (b"GET /picture/../../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n", 404),
        (b"GET /picture/depth HTTP/1.1\r\nHost: localhost\r\n\r\n", 404),
        (b"GET camera HTTP/1.1\r\nHost: localhost\r\n\r\n", 400),
    ],
)
def test_invalid_requests_get_an_error_response(raw, status):
    with Serving() as serving:
        assert serving.ask(raw)[0] == status
        assert serving.get("/")[0] == 200


def test_commands_need_the_token_and_valid_json():
    with Serving() as serving:

        def post(body, token=TOKEN):
            return serving.ask(
                f"POST /command HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {token}\r\n"
                f"Content-Length: {len(body)}\r\n\r\n{body}".encode()
            )

        order = '{"action": "set", "node": "depth", "parameters": {"a": 1}}'
        assert post(order, "wrong")[0] == 401
        assert post(order, "ключ")[0] == 401
        assert serving.orders == []
        assert serving.server.rejected_commands == 2
        assert post("[]")[0] == 400
        assert post('{"node": "depth"}')[0] == 400
        assert post('{"action": "set", "parameters": 3}')[0] == 400
        assert post(order) == (200, b'{"text":"done"}')
        assert serving.orders == [("set", "depth", {"a": "1"})]


def test_names_of_this_machine():
    access = PageAccess(names=frozenset({"localhost", "robot1"}))
    for host in ("localhost", "LOCALHOST:8420", "127.0.0.1:8420", "[::1]:8420", "192.168.0.7", "robot1:80"):
        assert access.is_own_host(host), host
    for host in ("", "evil.example", "127.0.0.1.evil.example:80", "robot10", "[evil]", "::1]"):
        assert not access.is_own_host(host), host


def test_depth_is_coloured_and_unknown_is_black():
    depth = np.full((60, 1280), 1.0, np.float32)
    depth[:, 640:] = np.nan
    rgb = cv2.imdecode(np.frombuffer(encode_depth(depth, 640).data, np.uint8), cv2.IMREAD_COLOR)
    assert rgb.shape == (30, 640, 3)
    assert rgb[:, 330:].max() < 12
    near = rgb[15, 100].astype(int)
    assert near[2] > near[0] + 80, "near is red (BGR)"


def test_the_map_is_cropped_to_known_cells():
    occupancy = np.full((40, 60), -1, np.int8)
    occupancy[10:20, 15:45] = 0
    occupancy[10, 15:45] = 100
    picture = encode_grid(occupancy, 0.1, np.array([-3.0, -2.0]))
    assert picture.metadata == {"x_m": -1.5, "y_m": -1.0, "cell_m": 0.1, "width": 30, "height": 10}
    pixels = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels.shape == (10, 30, 4)
    assert (pixels[-1, :, 0] == 20).all()
    assert (pixels[:-1, :, 0] == 235).all()
    assert (pixels[..., 3] == 255).all()
    with pytest.raises(ValueError, match="no cell of the map"):
        encode_grid(np.full((3, 3), -1, np.int8), 0.1, np.zeros(2))


def test_the_map_of_tiles_is_one_picture_with_larger_cells_if_it_is_very_large(monkeypatch):
    grid, source = TiledGrid(), GridSource("a", 0, 0.1, 16)
    walls = np.zeros((16, 16), np.int8)
    walls[3] = 100
    for column in range(8):
        grid.add(source, 0, column - 4, pack_tile(walls))
    picture = encode_tiles(grid)
    assert picture.metadata == {"x_m": -6.4, "y_m": 0.0, "cell_m": 0.1, "width": 128, "height": 16}
    monkeypatch.setattr("beamsplat.services.page.images._WIDEST_MAP_PX", 64)
    picture = encode_tiles(grid)
    assert picture.metadata == {"x_m": -6.4, "y_m": 0.0, "cell_m": 0.2, "width": 64, "height": 8}
    pixels = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert (pixels[-2, :, 0] == 20).all()  # thin walls remain


def test_nan_and_infinity_become_null():
    state = PageState(2.0, 2.0)
    state.service_status("fusion", "ok", scale=math.nan, scale_sigma=math.inf, detail="")
    state.scale(math.nan, 1.0)
    state.scale(1.0, math.nan)
    assert state.status()["words"]["fusion"]["scale"] is None
    assert state.scales()[0][1:] == [1.0, None]
    json.dumps([state.status(), state.scales(), state.robot(), state.path()], allow_nan=False)


def test_the_best_source_is_used_and_the_scan_is_drawn_at_its_pose():
    state = PageState(2.0, 2.0)
    ns = 1_000_000_000
    state.pose("wheel", ns, se2_to_se3(np.array([9.0, 9.0, 0.0])))
    state.correction(se2_to_se3(np.array([1.0, 0.0, np.pi / 2])))
    state.pose("localization", ns, se2_to_se3(np.array([1.0, 0.0, 0.0])))
    state.pose("wheel", 2 * ns, se2_to_se3(np.array([8.0, 8.0, 0.0])))
    state.lidar(se2_to_se3(np.array([0.5, 0.0, 0.0])))
    ranges = np.array([1.0, np.inf, np.nan, 2.0], np.float32)
    state.scan(int(1.5 * ns), ranges, 0.0, np.pi / 2, (0.1, 10.0))
    assert state.robot()["scan_cm"] == [], "where the robot was then is not known yet"
    state.pose("localization", 2 * ns, se2_to_se3(np.array([2.0, 0.0, 0.0])))
    state.scan(3 * ns, ranges, 0.0, np.pi / 2, (0.1, 10.0))
    robot = state.robot()
    assert (robot["source"], robot["x_m"], robot["y_m"]) == ("localization", 1.0, 2.0)
    assert robot["yaw_rad"] == pytest.approx(np.pi / 2, abs=1e-4)
    # Half way between the poses, at (1, 1.5): ahead is +y in the map, 1.5 + 0.5 + 1; to the right x = 1 + 2.
    assert robot["scan_cm"] == [100, 300, 300, 200]


def test_invalid_options_are_reported():
    with pytest.raises(UserError, match="at least 12 characters"):
        make_node(NODES["page"], {"token": "short"}, "x")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        node = PageNode(PageConfig(port=taken.getsockname()[1]))
        with pytest.raises(UserError, match=r"--set page\.port=PORT"):
            node.configure()
        node.close()
    with pytest.raises(UserError, match="cannot be used"):
        PageNode(PageConfig(port=0, certificate="/nowhere.pem")).configure()


def test_a_page_with_a_certificate_is_https(tmp_path):
    authority = CertificateAuthority.create(tmp_path)
    folder = authority.issue("edge", HostRole(role="edge"), ("127.0.0.1",))
    certificate, key = folder / CERTIFICATE, folder / KEY
    node = PageNode(PageConfig(port=0, certificate=certificate, certificate_key=key))
    node.configure()
    try:
        address = node.detail.removeprefix("open ")
        assert address.startswith("https://127.0.0.1:")
        context = ssl.create_default_context(cafile=folder / CA)
        with urllib.request.urlopen(address + "status", context=context, timeout=10) as reply:
            assert json.load(reply)["nodes"] == []
        with pytest.raises(OSError):
            urllib.request.urlopen(address.replace("https", "http"), timeout=10)
    finally:
        node.close()


def test_a_refused_depth_is_reported_and_shows_no_image():
    node = PageNode(PageConfig(port=0))
    node.configure()
    try:
        none = np.zeros((0, 0), np.float32)
        refused = FusedDepth.of(stamp_ns=1, depth_m=none, sigma_m=none, status="too few beams in the picture")
        list(node.handle("fusion/depth", refused))
        node.on_health(Health(stamp_ns=1, node="page", instance="ab", epoch=1, state="active"))
        status = node._fleet.own_state.status()
        assert status["words"]["fusion"]["status"] == "refused"
        assert status["words"]["fusion"]["detail"] == "too few beams in the picture"
        assert "fusion: refused" in [line["text"] for line in status["log"]]
        assert node._fleet.own_state.images["depth"].metadata() is None
    finally:
        node.close()
