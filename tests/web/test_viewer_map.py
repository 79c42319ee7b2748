"""The 3D viewer in a real browser: what it draws, and how it follows changes of the map."""

import base64
import json

import numpy as np

from beamsplat.common.geometry.transforms import make_transform
from beamsplat.common.mapfiles.store import transform_gaussians
from beamsplat.common.messages.splat_codec import pack
from beamsplat.common.raster.layout import COLOUR, MEAN
from tests.web.map_server import MapServer
from tests.web.scene import ROOM_M, looking, psnr_db, rendered, room, views
from tests.web.viewer_page import BUNDLE, COUNT, MARKS, picture, shows, wait

pytestmark = MARKS


def red(params):
    out = params.copy()
    out[COLOUR:] = np.array([[1.0], [0.0], [0.0]])
    return out


def test_pictures_agree_with_the_rasterizer(opened, server):
    params = room(40_000)
    server.put(0, params)
    page = opened(server.address + "view")
    wait(page, shows(40_000))
    decibels = [psnr_db(picture(page, T), rendered(params, T)) for T in views(10)]
    print("PSNR of the browser against the rasterizer, dB:", np.round(decibels, 1))
    assert len(decibels) == 10
    assert min(decibels) >= 35.0


def test_chunks_are_placed_by_their_anchor(opened, server):
    params = room(COUNT)
    T_map_anchor = make_transform(
        np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([20.0, 5.0, 0.3])
    )
    server.put(0, params, T_map_anchor)
    page = opened(server.address + "view")
    wait(page, shows(COUNT))
    (T_anchor_camera,) = views(1)
    T_map_camera = T_map_anchor @ T_anchor_camera
    assert (
        psnr_db(
            picture(page, T_map_camera), rendered(transform_gaussians(params, T_map_anchor), T_map_camera)
        )
        > 35.0
    )
    server.chunks[0] = (
        server.chunks[0][0],
        np.eye(4),
        *server.chunks[0][2:],
    )  # a loop closure: the pose only
    before = len([path for path in server.asked if "/chunk/" in path])
    server._changed()
    wait(page, lambda _: psnr_db(picture(page, T_anchor_camera), rendered(params, T_anchor_camera)) > 35.0)
    assert len([path for path in server.asked if "/chunk/" in path]) == before


def test_the_viewer_follows_map_and_robot(opened, server):
    params = room(COUNT)
    left = params[MEAN] < ROOM_M[0] / 2
    server.put(1, params[:, left])
    server.put(2, params[:, ~left])
    page = opened(server.address + "view")
    wait(page, shows(COUNT))
    (T,) = views(1)
    assert psnr_db(picture(page, T), rendered(params, T)) > 35.0
    server.put(1, red(params[:, left]))
    server.put(2, red(params[:, ~left]))
    wait(page, lambda now: now["revisions"] == {"1": 2, "2": 2} and now["complete"])
    drawn = picture(page, T)
    assert drawn[..., 0].mean() > 100
    assert drawn[..., 1:].max() < 3
    server.remove(2)
    wait(page, shows(int(left.sum())))

    assert page.is_disabled("text=Follow")
    server.robot(2.0, 3.0, 0.0)
    wait(page, lambda now: now["robot"] == {"x": 2, "y": 3, "z": 0, "yaw": 0})
    page.click("text=Robot's eyes")
    wait(page, lambda now: np.allclose(now["eye"][:2], [2.0, 3.0], atol=0.01))
    server.robot(2.5, 3.2, 0.5)
    wait(page, lambda now: np.allclose(now["eye"][:2], [2.5, 3.2], atol=0.01))
    server.publish("scan3d", {"T_map_lidar": np.eye(4).ravel().tolist(), "points": [[1.0, 0.0], [0.0, 1.0]]})
    server.publish("path", [0, 0, 100, 0, 250, 320])
    server.publish("scan3d", None)
    page.click("text=Whole map")
    wait(page, lambda now: now["mode"] == "orbit" and now["eye"][2] > 2.0)


def test_another_mapper_and_another_server(opened):
    first = MapServer()
    first.put(7, room(COUNT))
    page = opened(first.address + "view")
    wait(page, shows(COUNT))
    port = first.port
    first.close()
    page.wait_for_selector("text=not connected", timeout=20_000)
    with MapServer(port, producer="second") as second:
        second.put(7, room(3000, seed=8))  # the same anchor and revision, another map
        wait(page, shows(3000))
        page.reload()
        wait(page, shows(3000))
    lost = [fault for fault in page.faults if "ERR_" in fault]
    assert lost == page.faults  # the browser's own reports of the lost connection
    page.faults.clear()


def test_levels_of_detail_keep_the_budget(opened, server):
    params = room(60_000)
    for i in range(6):
        server.put(
            i, params[:, i::6], make_transform(np.eye(3), np.array([8.0 * i, 0.0, 0.0])), (0.0, 0.1, 0.4)
        )
    page = opened(server.address + "view")
    wait(page, lambda now: now["chunks"] == 6 and now["complete"])
    page.evaluate(
        "T => document.querySelector('#view').viewer.look(T)",
        looking([3.0, 3.5, 1.2], [3.0, 1.0, 1.0]).ravel().tolist(),
    )
    page.click("summary")
    page.get_by_label("Detail").select_option("50000")
    now = wait(page, lambda now: now["complete"] and now["chunks"] == 6 and now["gaussians"] <= 50_000)
    assert now["gaussians"] > 20_000  # it is used
    fine = server.chunks[0][0]
    assert any(
        f"/chunk/0?producer=first&revision={fine}&cell_m=0" == path.removeprefix("/map3d")
        for path in server.asked
    )
    assert any("/chunk/5?" in path and "cell_m=0.1" in path for path in server.asked)


def test_a_document_with_the_map_inside_needs_no_server(opened, tmp_path):
    params = room(COUNT)
    with MapServer() as server:
        server.put(0, params, cells_m=(0.0,))
        embedded = server.index() | {
            "keyframes": [],
            "data": {"0": base64.b64encode(pack(params)).decode()},
            "path": [0, 0, 100, 100],
        }
    bundle = BUNDLE.read_text().replace("</script", "<\\/script")
    text = f"""<!doctype html><meta charset="utf-8"><div id="view" style="height: 500px"></div>
<script type="module">{bundle}</script>
<script type="module">beamsplatViewer.openViewer(document.getElementById("view"), {{base: "", saved: true, embedded: {json.dumps(embedded)}}});</script>"""
    (tmp_path / "report.html").write_text(text)
    page = opened((tmp_path / "report.html").as_uri())
    wait(page, shows(COUNT))
    (T,) = views(1)
    assert psnr_db(picture(page, T), rendered(params, T)) > 35.0
    assert page.requests == [page.url]
