"""Nodes that cannot run: at the start an essential one ends the run; later none does, and it is tried again."""

import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.errors import UserError
from beamsplat.common.zenoh.bus import open_session
from beamsplat.tools.system.health_table import HealthTable
from tests.common.topic_listener import TopicListener

ROOT = Path(__file__).resolve().parents[3]
REPLAY = {"kind": "drive", "seconds": 300.0, "images": False}


class Run:
    """A system run by `beamsplat run` in a process of its own."""

    def __init__(self, tmp_path, endpoint, nodes):
        deployment = Deployment(
            robot="r1", router=RouterConfig(listen=(endpoint,)), state_dir=tmp_path, nodes=nodes
        )
        self._endpoint = endpoint
        self._file, self._output = tmp_path / "deployment.json", tmp_path / "output"
        self._file.write_text(deployment.model_dump_json())

    def __enter__(self):
        with self._output.open("w") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tests.tools.system.failing", self._file],
                cwd=ROOT, stdout=output, stderr=output,
            )  # fmt: skip
        try:
            self.session = open_session((self._endpoint,), 30.0, lambda: self.process.poll() is not None)
        except UserError:
            pytest.fail(f"no router; the run says: {self.output}")
        self.board = HealthTable(self.session, "r1")
        return self

    def __exit__(self, *exception):
        self.session.close()
        self.process.terminate()
        self.process.wait(20)

    @property
    def output(self):
        return self._output.read_text()

    def node(self, name):
        return self.board.snapshot()["nodes"].get(name, {"state": ""})

    def until(self, done, timeout_s=40.0):
        deadline = time.monotonic() + timeout_s
        while not done():
            assert self.process.poll() is None, f"the run has ended: {self.output}"
            assert time.monotonic() < deadline, (self.output, self.board.status_line())
            time.sleep(0.05)


def test_a_page_that_cannot_listen_leaves_localization_running_and_comes_back(tmp_path, free_endpoint):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        nodes = {"replay": REPLAY, "localization": {"kind": "failing"}, "page": {"port": port}}
        with Run(tmp_path, free_endpoint, nodes) as run:
            poses = TopicListener(run.session, "localization/odometry")
            run.until(lambda: run.node("page")["state"] == "failed" and len(poses.messages) > 20)
            assert f"cannot listen at 127.0.0.1:{port}" in run.node("page")["detail"]
            assert "page cannot run: page: cannot listen" in run.output
            taken.close()
            run.until(lambda: run.node("page")["state"] == "active")
            run.until(lambda: "page runs again" in run.output)


def test_an_essential_node_that_fails_after_the_start_is_tried_again(tmp_path, free_endpoint):
    file = tmp_path / "map"
    nodes = {"replay": REPLAY, "localization": {"kind": "failing", "needs": str(file)}}
    with Run(tmp_path, free_endpoint, nodes) as run:
        poses = TopicListener(run.session, "localization/odometry")
        run.until(lambda: run.node("localization")["state"] == "failed")
        assert run.node("localization")["detail"] == f"{file} has gone"
        count = len(poses.messages)
        file.touch()
        run.until(lambda: run.node("localization")["state"] == "active")
        run.until(lambda: len(poses.messages) > count + 5)


@pytest.mark.parametrize("essential", [None, False])
def test_at_the_start_an_essential_node_ends_the_run(tmp_path, free_endpoint, essential):
    options = {"kind": "failing", "fails_in_configure": True}
    options |= {} if essential is None else {"essential": essential}
    with Run(tmp_path, free_endpoint, {"replay": REPLAY, "localization": options}) as run:
        if essential is None:
            assert run.process.wait(40) == 2
            assert "error: localization cannot run: the wall height is negative" in run.output
        else:
            run.until(lambda: run.node("localization")["state"] == "failed")
            assert "localization cannot run: the wall height is negative; tried again in 5 s" in run.output


def test_what_a_robot_can_do_without_is_not_essential():
    from beamsplat.services.nodes import NODES

    dispensable = {"page", "monitor", "recorder", "ros2_out", "uplink"}
    assert {name for name, row in NODES.items() if not row.essential} == dispensable
    assert [name for name, row in NODES.items() if row.finite] == ["replay"]
