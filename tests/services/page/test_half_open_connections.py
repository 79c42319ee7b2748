"""A real page process with many connections that send nothing: it keeps answering, with few descriptors."""

import contextlib
import json
import re
import resource
import socket
import urllib.request

import psutil
import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.zenoh.bus import open_session
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.polling import poll

HALF_OPEN = 1000
DESCRIPTORS = 1024  # the usual RLIMIT_NOFILE of a process
MAX_DESCRIPTORS_MORE = 160  # the limit on connections is 128


@pytest.fixture
def page(tmp_path, free_endpoint):
    """(supervisor, health table, port) of a system whose only node is the page."""
    deployment = Deployment(
        robot="test",
        router=RouterConfig(listen=(free_endpoint,)),
        state_dir=tmp_path,
        nodes={"page": {"port": 0}},
    )
    with Supervisor(deployment) as supervisor, open_session((free_endpoint,)) as session:
        board = HealthTable(session, "test")
        poll(supervisor, lambda: board.states() == {"page": "active"}, 60)
        yield supervisor, board, int(re.search(r":(\d+)/", board.records["page"].health.detail)[1])


@pytest.fixture
def many_descriptors():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 4096), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def _status(port):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/status", timeout=10) as reply:
        return json.load(reply)


def test_a_thousand_half_open_connections_do_not_stop_the_page(page, many_descriptors):
    supervisor, board, port = page
    process = psutil.Process(supervisor.children["page"].process.pid)
    resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))
    before = peak = process.num_fds()
    with contextlib.ExitStack() as stack:
        for i in range(HALF_OPEN):
            connection = stack.enter_context(socket.socket())
            connection.setblocking(False)
            connection.connect_ex(("127.0.0.1", port))
            with contextlib.suppress(OSError):
                connection.send(b"GET /status HTTP/1.1\r\nHost: loc" if i % 2 else b"")
            if i % 50 == 0:
                supervisor.poll()
                peak = max(peak, process.num_fds())
        assert peak <= before + MAX_DESCRIPTORS_MORE
        assert _status(port)["nodes"][0]["state"] == "active", "the page answers although all others wait"
        assert process.num_fds() <= before + MAX_DESCRIPTORS_MORE
        reports = board.records["page"].health.stamp_ns
        poll(supervisor, lambda: board.records["page"].health.stamp_ns > reports + 2_000_000_000, 20)
        assert process.num_fds() <= before + MAX_DESCRIPTORS_MORE
    poll(supervisor, lambda: process.num_fds() <= before + 2, 20)
    assert _status(port)["nodes"][0]["starts"] == 1, "the process was not replaced"
    assert "connections" in board.records["page"].health.detail, "closed connections are counted"
