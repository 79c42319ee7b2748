"""`beamsplat view` on saved sessions and splat files, by real HTTP requests."""

import json
import urllib.request

import numpy as np
import pytest
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.ply import read_gaussian_ply, write_gaussian_ply
from beamsplat.common.mapfiles.scores import psnr_db
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.state import keyframe_views, store_of
from beamsplat.common.raster.layout import MEAN, SCALE
from beamsplat.tools.cli.main import app
from beamsplat.tools.view.saved_map import PIECE, pieces, ply_source
from beamsplat.tools.view.serving import MapViewer
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import feed, make_node
from tests.services.page.test_map3d import (
    get,
    index_of,
    means_in_map,
    pixels,
    status_of,
    view_query,
    wait_until,
)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A demo's folder with a session of five keyframes."""
    folder = tmp_path_factory.mktemp("view")
    node = make_node(folder / "session", half_steps=8, full_steps=6)
    feed(node, range(5))
    list(node.drain())
    node.close()
    return folder


@pytest.fixture(autouse=True)
def _no_proxy(monkeypatch):
    monkeypatch.setenv("no_proxy", "*")


def test_a_session_is_shown_with_its_keyframes_and_renders(session):
    arrays = SessionFolder(session / "session").read_state()
    store, views = store_of(arrays), keyframe_views(arrays)
    with MapViewer(session, "127.0.0.1", 0) as viewer:
        address = viewer.address.removesuffix("view")
        wait_until(lambda: len(index_of(address)["chunks"][0]["levels"]) > 1)
        index = index_of(address)
        assert (index["saved"], index["note"], index["editable"]) == (True, "", False)
        true = store.params[MEAN:SCALE, : store.count].T
        assert np.abs(np.sort(means_in_map(address, index), axis=0) - np.sort(true, axis=0)).max() < 2e-3
        assert len(means_in_map(address, index, level=9)) < 0.7 * store.count
        assert [k["id"] for k in index["keyframes"]] == [str(view.id) for view in views]
        assert np.allclose(index["keyframes"][2]["T_map_camera"], views[2].T_map_camera.ravel(), atol=1e-6)
        assert (index["camera"]["width"], index["camera"]["height"]) == (r.WIDTH, r.HEIGHT)
        image = get(address, f"map3d/keyframe/{views[1].id}")[0]
        assert psnr_db(pixels(image), r.shot(1)[0] / 255.0) > 28.0
        # Our render at a keyframe is near its image: both show the same place.
        query = view_query(views[1].T_map_camera, r.WIDTH, r.HEIGHT, r.FOCAL)
        assert psnr_db(pixels(get(address, query)[0]), r.shot(1)[0] / 255.0) > 18.0
        assert status_of(address, "map3d/keyframe/12345")[0] == 404
        with urllib.request.urlopen(address + "events", timeout=120) as events:
            assert b"event:" in events.readline()


@pytest.mark.parametrize("up", ["z", "y", "-y"])
def test_a_splat_file_is_shown_upright(session, tmp_path, up):
    store = store_of(SessionFolder(session / "session").read_state())
    params = store.params[:, : store.count]
    turned = params.copy()
    x, y, z = params[MEAN:SCALE]
    turned[MEAN:SCALE] = {"z": (x, y, z), "y": (x, z, -y), "-y": (x, -z, y)}[up]
    path = tmp_path / "map.ply"
    write_gaussian_ply(path, turned)
    source = ply_source(path, up)
    index = json.loads(json.dumps(source.index()))
    assert sum(chunk["levels"][0]["count"] for chunk in index["chunks"]) == store.count
    low = np.min([chunk["low"] for chunk in index["chunks"]], axis=0)
    high = np.max([chunk["high"] for chunk in index["chunks"]], axis=0)
    assert np.allclose(low, params[MEAN:SCALE].min(axis=1), atol=1e-3)
    assert np.allclose(high, params[MEAN:SCALE].max(axis=1), atol=1e-3)
    assert (index["keyframes"], index["camera"]) == ([], None)
    source.close()


def test_gaussians_survive_a_splat_file(tmp_path):
    rng = np.random.default_rng(1)
    params = rng.normal(size=(14, 500)).astype(np.float32)
    params[6:10] /= np.linalg.norm(params[6:10], axis=0)
    write_gaussian_ply(tmp_path / "a.ply", params)
    assert np.allclose(read_gaussian_ply(tmp_path / "a.ply"), params, atol=1e-5)
    params[0, 7] = np.nan
    write_gaussian_ply(tmp_path / "a.ply", params)
    assert read_gaussian_ply(tmp_path / "a.ply").shape == (14, 499)


def test_pieces_are_small_and_apart():
    rng = np.random.default_rng(0)
    params = np.zeros((14, 100_000), np.float32)
    params[:3] = rng.uniform(0.0, [[10.0], [4.0], [2.0]], (3, 100_000))
    params[3] = np.arange(100_000)
    parts = list(pieces(params))
    assert max(part.shape[1] for part in parts) <= PIECE
    assert np.array_equal(np.sort(np.concatenate([part[3] for part in parts])), params[3])
    assert all(np.ptp(part[0]) < 5.1 for part in parts)


def test_what_cannot_be_shown_is_named(tmp_path):
    points = tmp_path / "points.ply"
    points.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        b"property float z\nend_header\n" + bytes(12)
    )
    short = tmp_path / "short.ply"
    write_gaussian_ply(short, np.zeros((14, 10), np.float32))
    short.write_bytes(short.read_bytes()[:-9])
    empty = tmp_path / "empty.ply"
    write_gaussian_ply(empty, np.zeros((14, 0), np.float32))
    SessionFolder(tmp_path / "new").create()
    offline = tmp_path / "off.toml"
    offline.write_text('[router]\nlisten = ["tcp/127.0.0.1:1"]\n[nodes.mapping]\n')
    for path, words in (
        (tmp_path / "absent", "no such file or folder"),
        (points, "no Gaussian splats: its vertices have no property f_dc_0"),
        (short, "truncated: its header says 10"),
        (empty, "has no Gaussians"),
        (tmp_path / "new", "nothing has been saved"),
        (offline, "no router answers"),
    ):
        with pytest.raises(UserError, match=words):
            CliRunner().invoke(app, ["view", str(path), "--no-browser"], catch_exceptions=False)
    with pytest.raises(UserError, match="--up 'x': choose one of z, y, -y"):
        ply_source(points, "x")


def test_a_port_in_use_is_named(session):
    with MapViewer(session, "127.0.0.1", 0) as viewer:
        port = int(viewer.address.split(":")[2].split("/")[0])
        with pytest.raises(UserError, match="--port PORT"):
            MapViewer(session, "127.0.0.1", port)
