"""The controls of the 3D viewer in a real browser: measuring, slices, keyframes, keys; and whether everybody can use them."""

import json

import cv2
import numpy as np
import pytest

from tests.services.page.browser import DESK, PHONE
from tests.web.node import WEB
from tests.web.scene import looking, psnr_db, rendered, room, views
from tests.web.viewer_page import COUNT, MARKS, picture, shows, state, wait

pytestmark = MARKS


def test_distances_and_heights_are_measured(opened, server):
    server.put(0, room(40_000))
    page = opened(server.address + "view", reduced_motion="reduce")
    eye = np.array([3.0, 3.5, 1.2])
    wait(page, shows(40_000))
    # Look at the wall y = 0 over the block; what is in the middle and a known angle beside it is known.
    page.evaluate(
        "T => document.querySelector('#view').viewer.look(T)", looking(eye, [3.0, 0.0, 1.2]).ravel().tolist()
    )
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
    wait(page, lambda now: now["compared"] is not None)
    page.wait_for_function("document.querySelector('.v3-image').naturalWidth === 320")
    slider = page.locator("input[aria-label^='Border']")
    shots = {}
    for percent in (0, 100):  # all image, all render
        slider.fill(str(percent))
        wait(page, lambda now: now["resting"])  # the frame after a motion has all pixels
        box = page.locator(".v3-image").bounding_box()
        clip = {
            "x": box["x"] + 2,
            "y": box["y"] + 2,
            "width": box["width"] - 4,
            "height": 0.75 * box["height"],
        }
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
    page.evaluate(
        "T => document.querySelector('#view').viewer.look(T)", looking(from_m, T[:3, 3]).ravel().tolist()
    )
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
    found = page.evaluate(
        "async () => (await axe.run()).violations.map(v => [v.impact, v.id, v.nodes.map(n => n.html.slice(0, 120))])"
    )
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
