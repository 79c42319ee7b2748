"""The monitor as a process of a system: it draws, it saves, and no node waits for it."""

import itertools
import os
import re
import signal
import time
import urllib.request

import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.errors import UserError
from beamsplat.common.zenoh.bus import open_session
from beamsplat.services.monitor.node import MonitorConfig, MonitorNode
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.nodes import TABLE
from tests.common.polling import poll


def _sent(board, node, topic):
    return next(o.sent for o in board.records[node].health.outputs if o.topic == topic)


def _received(board, node, topic):
    return next(i for i in board.records[node].health.inputs if i.topic == topic)


@pytest.fixture
def system(tmp_path, free_endpoint):
    nodes = {
        "replay": {"kind": "drive", "seconds": 60.0, "image_bytes": 100_000},
        "localization": {"kind": "chain"},
        "monitor": {"grpc_port": 0, "web_port": 0, "save": str(tmp_path / "drive.rrd")},
    }
    deployment = Deployment(
        robot="test", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path, nodes=nodes
    )
    table = {**TABLE, "monitor": NODES["monitor"]}
    with Supervisor(deployment, table=table) as supervisor, open_session((free_endpoint,)) as session:
        board = HealthTable(session, "test")
        poll(supervisor, lambda: _flows(board), 60)
        yield supervisor, board, tmp_path / "drive.rrd"


def _flows(board):
    try:
        return _received(board, "monitor", "localization/odometry").received > 5
    except (KeyError, StopIteration):
        return False


def test_a_stopped_monitor_blocks_no_node_and_its_file_is_valid(system, read_rrd):
    supervisor, board, path = system
    page = re.search(r"http://127\.0\.0\.1:\d+/\?url=\S+", board.records["monitor"].health.detail)
    with urllib.request.urlopen(page.group().split("?")[0], timeout=10) as reply:
        assert reply.status == 200
        assert b"<html" in reply.read().lower()
    monitor = supervisor.children["monitor"].process.pid
    scans, pictures = (_sent(board, "replay", t) for t in ("lidar/scan", "camera/image"))
    os.kill(monitor, signal.SIGSTOP)
    try:
        # 5 s of data in real time, while the stopped monitor receives 3 MB of images per second.
        poll(supervisor, lambda: _sent(board, "replay", "lidar/scan") >= scans + 50, 15)
        assert _sent(board, "replay", "camera/image") >= pictures + 130
        slam = _received(board, "localization", "lidar/scan")
        assert (slam.lost, slam.dropped) == (0, 0)
    finally:
        os.kill(monitor, signal.SIGCONT)
    before = _received(board, "monitor", "localization/odometry").received
    poll(supervisor, lambda: _received(board, "monitor", "localization/odometry").received > before + 10, 30)
    assert supervisor.children["monitor"].process.pid == monitor
    supervisor.stop()
    saved = read_rrd(path)
    assert {
        "map/odom/body",
        "map/odom/body/camera/image",
        "map/scan",
        "log",
        "health/table",
    } <= saved.entities
    assert {f"plots/step_p95_ms/{n}" for n in ("replay", "localization", "monitor")} <= saved.entities
    stamps = saved.stamps("map/odom/body/camera/image")
    assert len(stamps) > 15
    assert all(b - a >= 90_000_000 for a, b in itertools.pairwise(stamps)), "10 Hz of 30"


def test_a_port_in_use_is_reported(free_endpoint):
    import socket

    port = int(free_endpoint.rpartition(":")[2])
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        monitor = MonitorNode(MonitorConfig(view="serve", grpc_port=port, web_port=0))
        with pytest.raises(UserError, match=f"127.0.0.1:{port} .*--set monitor.grpc_port=PORT"):
            monitor.configure()


def test_a_closed_viewer_window_is_reported_and_the_node_continues(monkeypatch, tmp_path, read_rrd):
    """Without a display the viewer ends at once; the file is written nevertheless."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monitor = MonitorNode(MonitorConfig(view="spawn", grpc_port=0, save=tmp_path / "a.rrd"))
    monitor.configure()
    deadline = time.monotonic() + 30.0
    while "window was closed" not in monitor.writer.status and time.monotonic() < deadline:
        time.sleep(0.1)
    assert "the data are still served" in monitor.writer.status
    monitor.panel.log("still here", None)
    monitor.close()
    assert "log" in read_rrd(tmp_path / "a.rrd").entities
