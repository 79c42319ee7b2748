"""The list of robots and the alerts in a real browser: content, keyboard, and updates without a reload."""

import time

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.messages import Health, NodeFigure
from beamsplat.services.page.images import encode_grid
from tests.services.page.browser import DESK, PHONE, browser
from tests.services.page.test_page_server import Serving

pytestmark = pytest.mark.slow  # a browser
NASTY = "<img src=x onerror=\"document.title='taken over'\">"


@pytest.fixture(scope="module")
def chromium():
    with browser() as it:
        yield it


def report(state, node, status="", **figures):
    """Give a robot the health of one node."""
    state.heard_s = time.monotonic()
    state.health(
        Health(
            stamp_ns=1, node=node, instance=f"{len(node):016x}", epoch=1, state="active", status=status,
            figures=tuple(NodeFigure(name=name, value=value) for name, value in figures.items()),
        )
    )  # fmt: skip


@pytest.fixture
def serving():
    """A page of the robots r0 (its own) and r1, which is lost."""
    with Serving() as it:
        there = it.fleet.state_of("r1")

        def tell(status="lost: " + NASTY):
            report(there, "localization", status)
            report(there, "uplink", link_up=1.0)
            report(there, "mapping", map_keyframes=12, map_gaussians=34567)
            there.pose("localization", 1, se2_to_se3(np.array([1.5, 0.0, 0.0])))

        occupancy = np.zeros((40, 60), np.int8)
        there.images["map"].update(lambda: encode_grid(occupancy, 0.1, np.zeros(2)))
        it.tell = tell
        yield it


def activate_alerts(serving, status="lost: " + NASTY):
    """Evaluate the alerts now and in eleven seconds, in which the robot reports the same."""
    for ahead_s in (0.0, 11.0):
        serving.tell(status)
        for record in serving.fleet.states()["r1"]._health.records.values():
            record.received_s = time.monotonic() + ahead_s
        serving.alerting.update(time.monotonic() + ahead_s, time.time() + ahead_s)


def opened(chromium, serving, path, size):
    page = chromium.new_page(viewport=size)
    page.faults = []
    page.on("console", lambda m: page.faults.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda e: page.faults.append(str(e)))
    page.goto(f"http://127.0.0.1:{serving.port}/{path}")
    return page


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_the_list_shows_each_robot_and_follows_it(chromium, serving, size):
    serving.tell("ok")
    page = opened(chromium, serving, "fleet", size)
    card = page.locator('[data-robot="r1"]')
    card.get_by_text("3 of 3 running").wait_for()
    text = card.inner_text()
    assert "12 keyframes, 34,567 Gaussians" in text
    assert "no uplink" not in text
    page.wait_for_function("document.querySelector('[data-robot=\"r1\"] img').naturalWidth === 60")
    assert card.locator("img").get_attribute("alt") == "Map of r1"
    assert page.inner_text("#alerts") == "none"
    activate_alerts(serving)
    page.locator("#alerts li", has_text="r1: lost, since").wait_for()
    assert NASTY in page.inner_text("#alerts"), "shown as text"
    assert page.title() == "BeamSplat: robots"
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), "scrolls sideways"
    assert page.faults == []
    page.close()


def test_the_keyboard_leads_to_a_robot_and_back(chromium, serving):
    activate_alerts(serving)
    page = opened(chromium, serving, "fleet", DESK)
    page.locator('[data-robot="r1"] a').wait_for()
    page.keyboard.press("Tab")  # r0
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.wait_for_url("**/robots/r1/")
    page.get_by_role("heading", name="BeamSplat: r1").wait_for()
    page.get_by_role("alert").get_by_text("lost, since").wait_for()
    page.wait_for_function("document.getElementById('pose').textContent.startsWith('1.50 m')")
    assert not page.is_visible("#commands"), "commands are on the robot's own page"
    page.get_by_role("link", name="All robots").press("Enter")
    page.wait_for_url("**/fleet")
    assert page.faults == []
    page.close()
