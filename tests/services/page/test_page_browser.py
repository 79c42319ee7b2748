"""The page of a running system in a real browser: content, faults, and commands with and without token."""

import contextlib
import json
import os
import signal
import threading
import urllib.error
import urllib.request

import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.zenoh.bus import open_session
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.commands import Commands
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.polling import poll
from tests.services.monitor.demo_system import NASTY, TABLE
from tests.services.page.browser import DESK, PHONE, browser

TOKEN = "correct horse battery"
pytestmark = pytest.mark.slow  # a system of five processes and a browser for each


@pytest.fixture(scope="module")
def chromium():
    with browser() as it:
        yield it


class PageSystem:
    """Supervised processes with a page."""

    def __init__(self, supervisor, session, address):
        self.supervisor, self.address = supervisor, address
        self.board = HealthTable(session, "test")
        self._commands = Commands(session, "test", supervisor)
        self.supervising = True

    def poll(self):
        if self.supervising:
            self.supervisor.poll()
        self._commands.answer_pending()

    def pids(self):
        return {name: child.process.pid for name, child in self.supervisor.children.items()}


@pytest.fixture
def start(tmp_path, free_endpoint):
    with contextlib.ExitStack() as stack:

        def starter(**options):
            port = _free_port()
            nodes = {"replay": {}, "localization": {}, "fusion": {}, "page": {"port": port, **options}}
            deployment = Deployment(
                robot="test", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path, nodes=nodes
            )
            table = {**TABLE, "page": NODES["page"]}
            supervisor = stack.enter_context(Supervisor(deployment, table=table))
            session = stack.enter_context(open_session((free_endpoint,)))
            running = PageSystem(supervisor, session, f"http://127.0.0.1:{port}/")
            poll(running, lambda: running.board.states() == dict.fromkeys(nodes, "active"), 60)
            return running

        yield starter


def _free_port():
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def opened(chromium, address, size):
    page = chromium.new_page(viewport=size)
    page.faults = []
    page.on("console", lambda m: page.faults.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda e: page.faults.append(str(e)))
    page.goto(address)
    try:
        yield page
    finally:
        page.close()


def _state(page, node):
    cells = page.query_selector_all(f'tr[data-node="{node}"] td')
    return cells[1].inner_text() if cells else ""


def _number(page, name):
    return int(page.get_attribute(f'[data-picture="{name}"] img', "data-number") or 0)


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_the_page_shows_the_running_system(chromium, start, size):
    system = start()
    with opened(chromium, system.address, size) as page:
        poll(system, lambda: _state(page, "fusion") == "active", 20)
        assert [_state(page, n) for n in ("replay", "localization", "page")] == ["active"] * 3
        poll(system, lambda: _number(page, "camera") > 0 and _number(page, "depth") > 0, 20)
        seen = _number(page, "camera")
        poll(system, lambda: _number(page, "camera") > seen, 10)
        assert page.eval_on_selector('[data-picture="camera"] img', "i => [i.naturalWidth, i.naturalHeight]") == [320, 240]  # fmt: skip
        assert not page.is_visible('[data-picture="render"] img'), "there is no mapper"
        poll(system, lambda: page.inner_text("#scale-text") == "1.250 ± 0.050", 10)
        assert "90 % of the lidar-depth pairs are inliers" in page.inner_text("#words")
        poll(system, lambda: "by localization" in page.inner_text("#pose"), 10)
        # Robot, path and map have different colours on the canvas.
        poll(system, lambda: page.evaluate(_COLOURS)["map"] > 1000, 10)
        colours = page.evaluate(_COLOURS)
        assert colours["robot"] > 20
        assert colours["path"] > 20
        poll(system, lambda: "10.0" in page.inner_text('tr[data-topic="camera/image"]'), 15)
        assert "page" in page.inner_text('tr[data-topic="camera/image"]')
        # Status texts of nodes are shown as text, not as HTML.
        assert NASTY in page.inner_text("#nodes")
        assert page.title() == "BeamSplat"
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), "scrolls sideways"
        assert not page.is_visible("#commands")
        assert page.faults == []
    reply = _command(system.address, {"action": "restart", "node": "fusion"}, TOKEN)
    assert reply == (403, "commands are disabled: the page's option `token` is empty")


_COLOURS = """() => {
  const c = document.getElementById("map"), counts = {robot: 0, path: 0, map: 0};
  const style = getComputedStyle(c), rgb = (name) => {
    const probe = document.createElement("canvas").getContext("2d");
    probe.fillStyle = style.getPropertyValue(name); probe.fillRect(0, 0, 1, 1);
    return [...probe.getImageData(0, 0, 1, 1).data];
  };
  const wanted = {robot: rgb("--robot"), path: rgb("--path"), map: [235, 235, 235, 255]};
  const data = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
  for (let i = 0; i < data.length; i += 4)
    for (const [name, w] of Object.entries(wanted))
      if (w.every((v, k) => Math.abs(v - data[i + k]) < 4)) counts[name]++;
  return counts;
}"""


def test_a_killed_node_is_shown_and_a_killed_page_reconnects(chromium, start):
    system = start()
    with opened(chromium, system.address, DESK) as page:
        poll(system, lambda: _state(page, "localization") == "active", 20)
        assert "4 of 4 nodes running" in page.inner_text("#summary")
        system.supervising = False
        os.kill(system.pids()["localization"], signal.SIGKILL)
        poll(system, lambda: _state(page, "localization").startswith("silent"), 15)
        assert "3 of 4 nodes running" in page.inner_text("#summary")
        assert "localization is silent" in page.inner_text("#log")
        system.supervising = True
        poll(system, lambda: _state(page, "localization") == "active (start 2)", 30)
        assert "localization was restarted" in page.inner_text("#log")
        os.kill(system.pids()["page"], signal.SIGKILL)
        poll(system, lambda: page.inner_text("#connection") == "not connected", 10)
        poll(system, lambda: page.inner_text("#connection") == "connected", 30)
        poll(system, lambda: _state(page, "fusion") == "active", 10)


def test_commands_need_the_token_in_the_browser(chromium, start):
    system = start(token=TOKEN)
    with opened(chromium, system.address, PHONE) as page:
        poll(system, lambda: page.is_visible("#login"), 20)
        assert not page.is_visible("#orders")
        before = system.pids()
        page.fill("#token", "correct horse batterz")
        page.click("#login button")
        poll(system, lambda: "wrong token" in page.inner_text("#answer"), 10)
        assert not page.is_visible("#orders")
        order = {"action": "restart", "node": "fusion"}
        assert _command(system.address, order, None)[0] == 401
        assert _command(system.address, order, TOKEN + "y")[0] == 401
        assert _command(system.address, order, TOKEN, method="GET")[0] == 405
        assert system.pids() == before
        page.fill("#token", TOKEN)
        page.click("#login button")
        poll(system, lambda: page.is_visible("#orders"), 10)
        page.on("dialog", lambda dialog: dialog.accept())
        page.select_option("#node", "fusion")
        page.click("#restart")
        poll(system, lambda: "fusion is stopped" in page.inner_text("#answer"), 20)
        poll(system, lambda: _state(page, "fusion") == "active (start 2)", 30)
        after = system.pids()
        assert {n for n in before if before[n] != after[n]} == {"fusion"}
    answers = []
    order = {"action": "restart", "node": "nobody"}
    threading.Thread(target=lambda: answers.append(_command(system.address, order, TOKEN))).start()
    poll(system, lambda: answers, 30)
    assert answers[0][0] == 409
    assert "no answer from node 'nobody' to the query 'restart'" in answers[0][1]
    assert _command(system.address, {"action": "explode", "node": "fusion"}, TOKEN)[0] == 409
    assert "commands rejected" in system.board.records["page"].health.detail


def test_a_swap_from_the_page_works(chromium, start):
    system = start(token=TOKEN)
    with opened(chromium, system.address, DESK) as page:
        poll(system, lambda: page.inner_text("#scale-text") == "1.250 ± 0.050", 20)
        page.fill("#token", TOKEN)
        page.click("#login button")
        poll(system, lambda: page.is_visible("#orders"), 10)
        page.on("dialog", lambda dialog: dialog.accept())
        page.select_option("#node", "fusion")
        before = system.pids()
        page.click("#options")
        poll(system, lambda: page.is_visible("#swap"), 10)
        assert page.input_value("#option-scale") == "1.25"
        page.fill("#option-scale", "much")
        page.click("#swap button")
        poll(
            system, lambda: "scale" in page.inner_text("#answer") and "much" in page.inner_text("#answer"), 20
        )
        assert system.pids() == before
        page.click("#options")
        poll(system, lambda: page.is_visible("#swap"), 10)
        page.fill("#option-scale", "1.5")
        page.click("#swap button")
        poll(system, lambda: page.inner_text("#scale-text") == "1.500 ± 0.050", 60)
        poll(system, lambda: "was taken over" in page.inner_text("#answer"), 20)
        after = system.pids()
        assert {n for n in before if before[n] != after[n]} == {"fusion"}


def _command(address, order, token, method="POST"):
    """Send a command as a script; return (status, text)."""
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    body = json.dumps(order).encode() if method == "POST" else None
    request = urllib.request.Request(address + "command", body, headers, method=method)
    try:
        with urllib.request.urlopen(request, timeout=30) as reply:
            return reply.status, json.load(reply)["text"]
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)["error"]
