"""The 3D viewer in a real browser: what it draws, how it follows changes, and whether everybody can use it."""

import base64
import json
import time

import cv2
import numpy as np
import pytest

from beamsplat.common.geometry.transforms import make_transform
from beamsplat.common.mapfiles.store import transform_gaussians
from beamsplat.common.messages.splat_codec import pack
from beamsplat.common.raster.layout import COLOUR, MEAN
from tests.services.page.browser import DESK, PHONE, browser
from tests.web.map_server import STATIC, MapServer
from tests.web.node import WEB
from tests.web.scene import CAMERA, ROOM_M, looking, psnr_db, rendered, room, views

BUNDLE = STATIC / "viewer" / "viewer.js"
COUNT = 12_000  # Gaussians where their number does not matter: the browser draws without a GPU
pytestmark = [
    pytest.mark.slow,
    pytest.mark.live,
    pytest.mark.skipif(not BUNDLE.exists(), reason="needs the built 3D viewer: make web"),
]


@pytest.fixture(scope="module")
def chromium():
    with browser() as it:
        yield it


@pytest.fixture
def server():
    with MapServer() as it:
        yield it


@pytest.fixture
def opened(chromium, server):
    """Return open(address, size): a page whose faults and foreign requests fail the test at its end.

    It is closed before the server.
    """
    pages = []

    def open_(address, size=DESK, **options):
        context = chromium.new_context(viewport=size, **options)
        page = context.new_page()
        page.faults = []
        page.on("console", lambda m: page.faults.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: page.faults.append(str(e)))
        page.on("request", lambda r: page.requests.append(r.url))
        page.requests = []
        page.goto(address)
        pages.append((context, page, address))
        return page

    yield open_
    for context, page, address in pages:
        foreign = [url for url in page.requests if not url.startswith((address.rsplit("/", 1)[0], "blob:"))]
        faults = list(page.faults)
        context.close()
        assert foreign == []
        assert faults == []


def state(page, box="#view"):
    return page.evaluate(f"document.querySelector('{box}').viewer?.state ?? null")


def wait(page, condition, seconds=30, box="#view"):
    """Wait until the viewer's state fulfils a condition; return the state."""
    end = time.monotonic() + seconds
    while True:
        now = state(page, box)
        if now is not None and condition(now):
            return now
        assert time.monotonic() < end, f"after {seconds} s: {now}, {page.faults}"
        page.wait_for_timeout(50)


def shows(count):
    return lambda now: now["gaussians"] == count and now["complete"]


def picture(page, T_map_camera, box="#view", camera=CAMERA):
    """Return what the viewer draws from a pose, uint8 [H, W, 3], RGB."""
    pinhole = {
        "T_map_camera": T_map_camera.ravel().tolist(), "fx": camera.fx_px, "fy": camera.fy_px, "cx": camera.cx_px,
        "cy": camera.cy_px, "width": camera.width_px, "height": camera.height_px,
    }  # fmt: skip
    text = page.evaluate(
        """async ([box, pinhole]) => {
          const bytes = new Uint8Array(await (await document.querySelector(box).viewer.picture(pinhole)).arrayBuffer());
          return btoa(Array.from(bytes, (b) => String.fromCharCode(b)).join(""));
        }""",
        [box, pinhole],
    )
    return cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


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
    T_map_anchor = make_transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([20.0, 5.0, 0.3]))
    server.put(0, params, T_map_anchor)
    page = opened(server.address + "view")
    wait(page, shows(COUNT))
    (T_anchor_camera,) = views(1)
    T_map_camera = T_map_anchor @ T_anchor_camera
    assert psnr_db(picture(page, T_map_camera), rendered(transform_gaussians(params, T_map_anchor), T_map_camera)) > 35.0
    server.chunks[0] = (server.chunks[0][0], np.eye(4), *server.chunks[0][2:])  # a loop closure: the pose only
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
    assert (picture(page, T)[..., 0].mean() > 100) and (picture(page, T)[..., 1:].max() < 3)
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
        server.put(i, params[:, i::6], make_transform(np.eye(3), np.array([8.0 * i, 0.0, 0.0])), (0.0, 0.1, 0.4))
    page = opened(server.address + "view")
    wait(page, lambda now: now["chunks"] == 6 and now["complete"])
    page.evaluate("T => document.querySelector('#view').viewer.look(T)", looking([3.0, 3.5, 1.2], [3.0, 1.0, 1.0]).ravel().tolist())
    page.click("summary")
    page.get_by_label("Detail").select_option("50000")
    now = wait(page, lambda now: now["complete"] and now["chunks"] == 6 and now["gaussians"] <= 50_000)
    assert now["gaussians"] > 20_000  # it is used
    fine = server.chunks[0][0]
    assert any(f"/chunk/0?producer=first&revision={fine}&cell_m=0" == path.removeprefix("/map3d") for path in server.asked)
    assert any("/chunk/5?" in path and "cell_m=0.1" in path for path in server.asked)


def test_distances_and_heights_are_measured(opened, server):
    server.put(0, room(40_000))
    page = opened(server.address + "view", reduced_motion="reduce")
    eye = np.array([3.0, 3.5, 1.2])
    wait(page, shows(40_000))
    # Look at the wall y = 0 over the block; what is in the middle and a known angle beside it is known.
    page.evaluate("T => document.querySelector('#view').viewer.look(T)", looking(eye, [3.0, 0.0, 1.2]).ravel().tolist())
    page.click("text=Measure")
    box = page.locator("#view canvas").bounding_box()
    focal = box["height"] / 2 / np.tan(np.pi / 6)
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.click(*middle)
    page.wait_for_selector("text=Height above the floor")
    height = float(page.inner_text(".v3-status").split()[-2])
    assert abs(height - 1.2) < 0.01
    right_m = 1.0  # on the wall, 3.5 m away
    page.mouse.click(middle[0] + focal * right_m / 3.5, middle[1])
    page.wait_for_selector("text=Distance")
    words = page.inner_text(".v3-status").split()
    assert abs(float(words[1]) - right_m) < 0.02
    assert page.get_attribute("text=Measure", "aria-pressed") == "true"


def test_heights_are_sliced_and_shades_change(opened, server):
    params = room(COUNT)
    server.put(0, params)
    page = opened(server.address + "view")
    wait(page, shows(COUNT))
    page.click("summary")
    T = looking([3.0, 3.0, 1.3], [3.01, 3.0, 0.0])  # down
    assert picture(page, T).mean() > 20
    lowest = page.locator("input[aria-label^='Lowest']")
    lowest.fill("1")
    page.wait_for_selector("text=1.00 m to")
    assert picture(page, T).max() == 0  # floor and block are cut off
    lowest.fill(lowest.get_attribute("min"))
    colour = picture(page, T)
    page.get_by_label("Shading").select_option("depth")
    depth = picture(page, T)
    assert np.abs(depth.astype(int) - colour).mean() > 10
    assert depth[..., 0].mean() > depth[..., 2].mean()  # 1.3 m of 0.3 to 8 m: reddish
    page.wait_for_selector("text=0.3 m is red")
    page.get_by_label("Shading").select_option("uncertainty")
    assert np.abs(picture(page, T).astype(int) - depth).mean() > 10


def test_a_keyframe_is_compared_at_one_click(opened, server):
    params = room(COUNT)
    server.put(0, params)
    for number, T in enumerate(views(3)):
        server.keyframes[10**18 + number] = T, rendered(params, T)
    page = opened(server.address + "view")
    wait(page, shows(COUNT))
    page.click("text=Compare")
    now = wait(page, lambda now: now["compared"] is not None)
    T, image = server.keyframes[int(now["compared"])]
    page.wait_for_function("document.querySelector('.v3-image').naturalWidth === 320")
    slider = page.locator("input[aria-label^='Border']")
    shots = {}
    for percent in (0, 100):  # all image, all render
        slider.fill(str(percent))
        wait(page, lambda now: now["resting"])  # the frame after a motion has all pixels
        box = page.locator(".v3-image").bounding_box()
        clip = {"x": box["x"] + 2, "y": box["y"] + 2, "width": box["width"] - 4, "height": 0.75 * box["height"]}
        shot = cv2.imdecode(np.frombuffer(page.screenshot(clip=clip), np.uint8), cv2.IMREAD_COLOR)
        shots[percent] = cv2.resize(shot, (240, 135), interpolation=cv2.INTER_AREA)
    assert psnr_db(shots[0], shots[100]) > 22.0  # the render is sharper than the enlarged image
    shifted = np.roll(shots[0], 6, axis=1)
    assert psnr_db(shots[0], shots[100]) > psnr_db(shifted, shots[100]) + 3.0
    page.click(".v3-compare-bar >> text=Close")
    wait(page, lambda now: now["compared"] is None)


def test_keyframes_show_their_thumbnails_on_hover(opened, server):
    params = room(COUNT)
    server.put(0, params)
    T = looking([2.0, 4.0, 1.0], [3.0, 1.0, 1.0])
    server.keyframes[10**18] = T, rendered(params, T)
    page = opened(server.address + "view", reduced_motion="reduce")
    wait(page, shows(COUNT))
    from_m = [4.0, 4.0, 1.0]
    page.evaluate("T => document.querySelector('#view').viewer.look(T)", looking(from_m, T[:3, 3]).ravel().tolist())
    box = page.locator("#view canvas").bounding_box()
    page.mouse.move(box["x"] + 5, box["y"] + 5)
    assert not page.is_visible(".v3-thumb")
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.wait_for_selector(".v3-thumb", state="visible")
    page.wait_for_function("document.querySelector('.v3-thumb img').naturalWidth === 160")
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    wait(page, lambda now: now["compared"] == str(10**18))


def test_keys_move_the_view(opened, server):
    server.put(0, room(COUNT))
    page = opened(server.address + "view")
    wait(page, shows(COUNT))
    page.focus("#view canvas")
    before = state(page)["eye"]
    page.keyboard.press("ArrowLeft")
    turned = wait(page, lambda now: not np.allclose(now["eye"], before, atol=1e-3))["eye"]
    page.keyboard.press("+")
    wait(page, lambda now: not np.allclose(now["eye"], turned, atol=1e-3))
    page.keyboard.press("2")
    wait(page, lambda now: now["mode"] == "fly")
    at = state(page)["eye"]
    page.keyboard.down("w")
    wait(page, lambda now: np.linalg.norm(np.subtract(now["eye"], at)) > 0.3)
    page.keyboard.up("w")
    page.keyboard.press("m")
    page.wait_for_selector("text=click a point")
    assert page.get_attribute("text=Fly", "aria-pressed") == "true"


AXE = WEB / "node_modules" / "axe-core" / "axe.min.js"


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
@pytest.mark.parametrize("path", ["view", "#3d"], ids=["view", "page"])
def test_everybody_can_use_it(opened, server, size, path):
    if not AXE.exists():
        pytest.skip("needs axe-core: cd web && npm ci")
    server.put(0, room(3000))
    server.keyframes[1] = views(1)[0], np.zeros((240, 320, 3), np.uint8)
    page = opened(server.address + path, size, has_touch=size is PHONE, is_mobile=size is PHONE)
    box = "#view" if path == "view" else "#map3d"
    wait(page, shows(3000), box=box)
    page.click("summary")
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), "scrolls sideways"
    page.evaluate(AXE.read_text())
    found = page.evaluate("async () => (await axe.run()).violations.map(v => [v.impact, v.id, v.nodes.map(n => n.html.slice(0, 120))])")
    assert [f for f in found if f[0] in ("serious", "critical")] == [], json.dumps(found, indent=1)


def test_the_tab_of_the_page_opens_and_closes_the_viewer(opened, server):
    server.put(0, room(3000))
    page = opened(server.address)
    assert state(page, "#map3d") is None
    assert "viewer.js" not in " ".join(server.asked)  # loaded when it is wanted
    page.click("#tab-3d")
    wait(page, shows(3000), box="#map3d")
    assert page.get_attribute("#tab-3d", "aria-selected") == "true"
    assert not page.is_visible("#map")
    page.keyboard.press("ArrowLeft")
    page.wait_for_selector("#map", state="visible")
    assert page.query_selector("#map3d canvas") is None


def test_without_the_bundle_the_flat_map_stays(opened, server):
    server.hidden.add("/viewer/viewer.js")
    page = opened(server.address)
    page.click("#tab-3d")
    page.wait_for_selector("text=make web")
    assert page.is_visible("#map")
    assert all("404" in fault for fault in page.faults)
    page.faults.clear()


def test_a_document_with_the_map_inside_needs_no_server(opened, tmp_path):
    params = room(COUNT)
    with MapServer() as server:
        server.put(0, params, cells_m=(0.0,))
        embedded = server.index() | {"keyframes": [], "data": {"0": base64.b64encode(pack(params)).decode()}, "path": [0, 0, 100, 100]}
    text = f"""<!doctype html><meta charset="utf-8"><div id="view" style="height: 500px"></div>
<script type="module">{BUNDLE.read_text().replace("</script", "<\\/script")}</script>
<script type="module">beamsplatViewer.openViewer(document.getElementById("view"), {{base: "", saved: true, embedded: {json.dumps(embedded)}}});</script>"""
    (tmp_path / "report.html").write_text(text)
    page = opened((tmp_path / "report.html").as_uri())
    wait(page, shows(COUNT))
    (T,) = views(1)
    assert psnr_db(picture(page, T), rendered(params, T)) > 35.0
    assert page.requests == [page.url]
