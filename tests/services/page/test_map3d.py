"""The 3D map over real HTTP requests: a real page node and a real mapper on a real router."""

import gzip
import json
import threading
import time
import urllib.error
import urllib.request
from functools import partial

import cv2
import numpy as np
import pytest

from beamsplat.common.geometry.transforms import transform_points
from beamsplat.common.mapfiles.scores import psnr_db
from beamsplat.common.messages import Health, MapAnchors, Rig
from beamsplat.common.messages.instances import process_of
from beamsplat.common.messages.splat_codec import unpack
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import MEAN
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.zenoh.bus import Bus, open_router, open_session
from beamsplat.common.zenoh.queries import reply
from beamsplat.services.mapping.preview import render_view
from beamsplat.services.page.map3d import live_session
from beamsplat.services.page.node import PageConfig, PageNode
from beamsplat.tools.view.serving import MapViewer
from tests.common import polling
from tests.conftest import free_port
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import feed, make_node

ROBOT = "robot1"
wait_until = partial(polling.wait_until, timeout_s=120.0)  # on a busy machine too


class RunningMapper:
    """A mapper that answers queries and publishes on a real bus, as the live runner does."""

    def __init__(self, endpoint, epoch, folder):
        self.node = make_node(folder)
        _, self.epoch, self.instance = process_of(b"seed", "mapping", epoch)
        self.bus = Bus(open_session((endpoint,)), ROBOT, "mapping", self.instance, epoch)
        self._chunks = self.bus.publish("mapping/chunk")
        self._lock = threading.Lock()
        self.asked = []
        self.bus.answer_queries(self._answer)
        self.bus.announce(self.node.queries())

    def _answer(self, name, query):
        self.asked.append(name)
        with self._lock:
            reply(query, getattr(self.node, f"on_query_{name}")(dict(query.parameters)))

    def map_keyframes(self, numbers):
        with self._lock:
            chunks = feed(self.node, numbers).get("mapping/chunk", [])
            chunks += [message for topic, message in self.node._publish_all() if topic == "mapping/chunk"]
        for chunk in chunks:
            self._chunks.put(chunk)

    def health(self):
        return Health(stamp_ns=1, node="mapping", instance=self.instance, epoch=self.epoch, state="active")

    def report(self):
        self.bus.publish_health(self.health())

    def means_m(self):
        store = self.node._mapper.store
        return store.params[MEAN : MEAN + 3, : store.count].T.astype(np.float64)

    def close(self):
        self.bus.session.close()
        self.node.close()


@pytest.fixture
def endpoint(monkeypatch):
    monkeypatch.setenv("no_proxy", "*")
    it = f"tcp/127.0.0.1:{free_port()}"
    with open_router((it,)):
        yield it


@pytest.fixture
def mapper(endpoint, tmp_path):
    running = RunningMapper(endpoint, 1, tmp_path / "session")
    running.map_keyframes(range(3))
    yield running
    running.close()


class LivePage:
    """A page node of the robot, with a real server and session."""

    def __init__(self, endpoint, folder, **options):
        self.node = PageNode(PageConfig(port=0, **options))
        self.node.live_settings = LiveSettings(ROBOT, (endpoint,), folder)
        self.node.configure()
        self.address = self.node.detail.removeprefix("open ")
        list(self.node.handle("rig", Rig(stamp_ns=1, camera=r.CAMERA_MODEL)))

    @property
    def map3d(self):
        return self.node._server._views.of(ROBOT).map3d

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.node.close()


def get(address, path, **headers):
    """Return (body, headers) of a response."""
    request = urllib.request.Request(address + path, headers=headers)
    with urllib.request.urlopen(request, timeout=120) as response:
        return response.read(), response.headers


def status_of(address, path):
    try:
        get(address, path)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)["error"]
    return 200, ""


def index_of(address):
    return json.loads(get(address, "map3d")[0])


def pixels(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(np.float64) / 255.0


def means_in_map(address, index, level=0):
    """Return the means [N, 3] (m, map frame) of a level of all chunks, as a browser gets them."""
    parts = []
    for chunk in index["chunks"]:
        cell_m = chunk["levels"][min(level, len(chunk["levels"]) - 1)]["cell_m"]
        path = f"map3d/chunk/{chunk['anchor']}?producer={index['producer']}&revision={chunk['revision']}&cell_m={cell_m}"
        packed, headers = get(address, path)
        assert headers["Content-Type"] == "application/octet-stream"
        assert "immutable" in headers["Cache-Control"]
        T = np.reshape(chunk["T_map_anchor"], (4, 4))
        parts.append(transform_points(T, unpack(np.frombuffer(packed, np.uint8))[:3].T.astype(np.float64)))
    return np.concatenate(parts)


def complete(address, mapper):
    """Wait until the page has all Gaussians of a mapper; return its index."""
    found = {}

    def there():
        found.update(index_of(address))
        count = sum(chunk["levels"][0]["count"] for chunk in found["chunks"])
        return count == len(mapper.means_m()) and len(found["keyframes"]) == len(
            mapper.node._mapper.keyframes
        )

    wait_until(there)
    return found


def view_query(T_map_camera, width=80, height=60, focal_px=55.0):
    numbers = ",".join(repr(v) for v in T_map_camera.ravel().tolist())
    return f"map3d/render?T={numbers}&width={width}&height={height}&focal_px={focal_px}"


def test_a_browser_gets_the_map_of_the_running_mapper(endpoint, mapper, tmp_path):
    with LivePage(endpoint, tmp_path) as page:
        page.node.on_health(mapper.health())
        time.sleep(0.3)
        assert not page.map3d.active
        assert mapper.asked == [], "nobody looks, so nothing is asked for or kept"
        index = complete(page.address, mapper)
        assert (index["saved"], index["note"], index["limited"]["coarsened"]) == (False, "", 0)
        found, true = means_in_map(page.address, index), mapper.means_m()
        assert np.abs(np.sort(found, axis=0) - np.sort(true, axis=0)).max() < 2e-3
        # Keyframes: pose, image and thumbnail.
        core = mapper.node._mapper
        for keyframe in index["keyframes"]:
            T = np.reshape(keyframe["T_map_camera"], (4, 4))
            assert np.abs(T - core.T_map_camera(core.keyframes[int(keyframe["id"])])).max() < 1e-5
        first = index["keyframes"][0]["id"]
        image, headers = get(page.address, f"map3d/keyframe/{first}")
        assert "immutable" in headers["Cache-Control"]
        assert psnr_db(pixels(image), r.shot(0)[0] / 255.0) > 28.0
        assert pixels(get(page.address, f"map3d/keyframe/{first}?width=64")[0]).shape == (48, 64, 3)
        assert index["camera"]["K"][0] == r.FOCAL
        # A render from a pose off the path, beside one that is made here.
        T_map_camera = r.T_map_body(1) @ r.T_BODY_CAMERA
        T_map_camera[:3, 3] += 0.05
        shown = pixels(get(page.address, view_query(T_map_camera))[0])
        camera = RasterCamera(55.0, 55.0, 39.5, 29.5, 80, 60)
        truth = render_view(core, T_map_camera, camera).rgb / 255.0
        assert psnr_db(shown, truth) > 26.0  # of a JPEG, whose colours have half the resolution


def test_changes_are_announced_and_arrive(endpoint, mapper, tmp_path):
    with LivePage(endpoint, tmp_path) as page:
        page.node.on_health(mapper.health())
        before = complete(page.address, mapper)
        with urllib.request.urlopen(page.address + "events?scan=1", timeout=120) as events:
            lines = iter(events.readline, b"")
            revision = next(data["revision"] for data in _data_of(lines, "map3d"))
            assert revision >= before["revision"]
            mapper.map_keyframes(range(3, 6))  # the second half of the path has another anchor
            changed = next(d for d in _data_of(lines, "map3d") if d["revision"] > revision)
            assert changed["producer"] == before["producer"]
        after = complete(page.address, mapper)
        assert {chunk["anchor"] for chunk in after["chunks"]} == {0, 1}
        old = next(chunk for chunk in before["chunks"] if chunk["anchor"] == 0)
        gone = f"map3d/chunk/0?producer=other&revision={old['revision']}&cell_m=0.0"
        code, text = status_of(page.address, gone)
        assert code == 404
        assert "ask for /map3d again" in text


def _data_of(lines, kind):
    """Yield the data of the events of one kind."""
    named = False
    for line in lines:
        if line.startswith(b"event:"):
            named = line.split(b":", 1)[1].strip() == kind.encode()
        elif named and line.startswith(b"data:"):
            yield json.loads(line[5:])


def test_a_loop_closure_moves_anchors_and_sends_no_chunk_again(endpoint, mapper, tmp_path):
    with LivePage(endpoint, tmp_path) as page:
        page.node.on_health(mapper.health())
        (before,) = complete(page.address, mapper)["chunks"]
        T = r.JUMP @ np.reshape(before["T_map_anchor"], (4, 4))
        moved = MapAnchors(stamp_ns=1, pose_revision=10, anchor_ids=np.array([0]), T_map_anchor=T[None])
        mapper.bus.publish("mapping/anchors").put(moved)
        wait_until(lambda: index_of(page.address)["chunks"][0]["T_map_anchor"] != before["T_map_anchor"])
        (after,) = index_of(page.address)["chunks"]
        assert np.allclose(np.reshape(after["T_map_anchor"], (4, 4)), T, atol=1e-6)
        assert (after["revision"], after["levels"][0]) == (before["revision"], before["levels"][0])


def test_a_restarted_mapper_is_another_map(endpoint, mapper, tmp_path):
    with LivePage(endpoint, tmp_path) as page:
        page.node.on_health(mapper.health())
        first = complete(page.address, mapper)
        mapper.close()
        second = RunningMapper(endpoint, 2, tmp_path / "other")
        try:
            second.map_keyframes(range(2))
            page.node.on_health(second.health())
            wait_until(lambda: index_of(page.address)["producer"] not in ("", first["producer"]))
            index = complete(page.address, second)
            assert index["producer"].startswith(second.instance)
            assert len(index["keyframes"]) == 2
        finally:
            second.close()


def test_the_map_is_freed_when_nobody_looks_any_more(endpoint, mapper, tmp_path, monkeypatch):
    monkeypatch.setattr(live_session, "IDLE_S", 0.5)
    with LivePage(endpoint, tmp_path) as page:
        page.node.on_health(mapper.health())
        index_of(page.address)
        wait_until(lambda: page.map3d.map.index())
        # The flat page alone does not keep the map.
        with urllib.request.urlopen(page.address + "events", timeout=120):
            wait_until(lambda: not page.map3d.active)
        assert page.map3d.map.index() == []
        complete(page.address, mapper)


def test_a_page_without_a_mapper_says_so_and_bad_requests_are_refused(endpoint, tmp_path):
    with LivePage(endpoint, tmp_path, map3d_mb=1.0) as page:
        wait_until(lambda: index_of(page.address)["note"] == "no mapper is running")
        assert index_of(page.address)["chunks"] == []
        for path, code, words in (
            ("map3d/chunk/0", 404, "revision"),
            ("map3d/chunk/x?revision=1&cell_m=0", 404, "revision"),
            ("map3d/chunk/0?revision=1&cell_m=0", 404, "gone"),
            ("map3d/keyframe/5", 404, "no keyframe 5"),
            ("map3d/keyframe/x", 404, "numbers"),
            ("map3d/render", 400, "T: expected 16 numbers"),
            (view_query(2.0 * np.eye(4)), 400, "T: expected a rotation"),
            (view_query(np.full((4, 4), np.nan)), 400, "T: expected a rotation"),
            (view_query(np.eye(4), width=5), 400, "width: expected a number from 16 to 1280"),
            (view_query(np.eye(4), focal_px=1e9), 400, "focal_px: expected a number"),
            ("viewer/none.js", 404, "make web"),
            ("robots/robot9/map3d", 404, "no robot"),
        ):
            found, text = status_of(page.address, path)
            assert found == code, path
            assert words in text, path
        code, text = status_of(page.address, view_query(np.eye(4)))
        assert code == 503
        assert "mapping" in text
        body, headers = get(page.address, "map3d", **{"Accept-Encoding": "gzip"})
        assert headers["Content-Encoding"] == "gzip"
        assert json.loads(gzip.decompress(body)) == index_of(page.address)


def test_the_newest_scan_is_sent_to_those_who_ask_for_it(endpoint, tmp_path):
    with LivePage(endpoint, tmp_path) as page:
        state, ns = page.node._fleet.own_state, 1_000_000_000
        T_body_lidar = np.eye(4)
        T_body_lidar[:3, 3] = 0.2, 0.0, 0.3
        state.lidar(T_body_lidar)
        state.scan(ns, np.array([1.0, 2.0], np.float32), 0.0, np.pi / 2, (0.1, 10.0))
        state.pose("localization", ns, r.T_map_body(0))
        with urllib.request.urlopen(page.address + "events?scan=1", timeout=120) as events:
            scan = next(d for d in _data_of(iter(events.readline, b""), "scan3d") if d is not None)
        assert np.allclose(scan["points"], [[1.0, 0.0], [0.0, 2.0]], atol=1e-3)
        assert np.allclose(np.reshape(scan["T_map_lidar"], (4, 4)), r.T_map_body(0) @ T_body_lidar, atol=1e-4)
        with urllib.request.urlopen(page.address + "events", timeout=120) as events:
            seen = b"".join(events.readline() for _ in range(12))
        assert b"event: robot" in seen
        assert b"scan3d" not in seen


def test_view_shows_a_running_deployment(endpoint, mapper, tmp_path):
    file = tmp_path / "live.toml"
    file.write_text(f'robot = "{ROBOT}"\n[router]\nlisten = ["{endpoint}"]\n[nodes.mapping]\n')
    with MapViewer(file, "127.0.0.1", 0) as viewer:
        address = viewer.address.removesuffix("view")
        rig = mapper.bus.publish("rig")
        rig.put(Rig(stamp_ns=1, camera=r.CAMERA_MODEL))

        def shown():
            mapper.report()
            rig.put(Rig(stamp_ns=1, camera=r.CAMERA_MODEL))
            index = index_of(address)
            return index["keyframes"] and sum(c["levels"][0]["count"] for c in index["chunks"]) == len(
                mapper.means_m()
            )

        wait_until(shown)
        index = index_of(address)
        assert not index["saved"]
        assert (
            np.abs(np.sort(means_in_map(address, index), axis=0) - np.sort(mapper.means_m(), axis=0)).max()
            < 2e-3
        )
        assert (
            psnr_db(
                pixels(get(address, f"map3d/keyframe/{index['keyframes'][0]['id']}")[0]), r.shot(0)[0] / 255.0
            )
            > 28.0
        )
