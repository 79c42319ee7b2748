"""CPU cost of ten open pages: everything is encoded once and sent ten times."""

import json
import re
import socket
import threading
import time

import psutil
import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.zenoh.bus import open_session
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.polling import poll
from tests.services.monitor.demo_system import TABLE

SECONDS = 20.0


class BrowserClient(threading.Thread):
    """Acts as a browser with the page: receives the events and fetches each announced image."""

    def __init__(self, port):
        super().__init__(daemon=True)
        self.images, self.events, self._port, self._on = 0, 0, port, True
        self.start()

    def run(self):
        stream, pictures = (socket.create_connection(("127.0.0.1", self._port), timeout=10) for _ in range(2))
        with stream, pictures, stream.makefile("rb") as lines, pictures.makefile("rb") as replies:
            stream.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
            for line in lines:
                if not self._on:
                    return
                self.events += line.startswith(b"event:")
                if line.startswith(b"data:") and b'"number"' in line:
                    name = json.loads(line[5:])["name"].encode()
                    pictures.sendall(b"GET /picture/%s HTTP/1.1\r\nHost: localhost\r\n\r\n" % name)
                    head = b"".join(iter(replies.readline, b"\r\n"))
                    assert head.startswith(b"HTTP/1.1 200")
                    assert len(replies.read(int(re.search(rb"Content-Length: (\d+)", head)[1]))) > 100
                    self.images += 1

    def leave(self):
        self._on = False
        self.join(10)


def _cpu_percent(process, supervisor):
    """Return the CPU load of a process in percent of a core, over some seconds."""
    began, before = time.monotonic(), process.cpu_times()
    while time.monotonic() < began + SECONDS:
        supervisor.poll()
        time.sleep(0.2)
    after = process.cpu_times()
    return 100.0 * (after.user + after.system - before.user - before.system) / (time.monotonic() - began)


@pytest.mark.slow
def test_nine_more_pages_cost_little_cpu(tmp_path, free_endpoint):
    nodes = {"replay": {}, "localization": {}, "fusion": {}, "page": {"port": 0}}
    deployment = Deployment(
        robot="test", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path, nodes=nodes
    )
    table = {**TABLE, "page": NODES["page"]}
    with Supervisor(deployment, table=table) as supervisor, open_session((free_endpoint,)) as session:
        board = HealthTable(session, "test")
        poll(supervisor, lambda: board.states() == dict.fromkeys(nodes, "active"), 60)
        port = int(re.search(r":(\d+)/", board.records["page"].health.detail)[1])
        process = psutil.Process(supervisor.children["page"].process.pid)
        none = _cpu_percent(process, supervisor)
        viewers = [BrowserClient(port)]
        one = _cpu_percent(process, supervisor)
        viewers += [BrowserClient(port) for _ in range(9)]
        ten = _cpu_percent(process, supervisor)
        for viewer in viewers:
            viewer.leave()
    print(f"page: {none:.1f} % of a core for nobody, {one:.1f} for one viewer, {ten:.1f} for ten")
    assert all(v.images > 50 and v.events > 100 for v in viewers)
    assert ten - one < 5.0
