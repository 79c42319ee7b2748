"""SIGTERM ends a process soon, in whatever state it is."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.messages import ExternalPose
from beamsplat.common.zenoh.bus import Bus, open_router, open_session
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor

ROOT = Path(__file__).resolve().parents[3]

_SERVE = """
    import sys, time
    from pathlib import Path
    import numpy as np
    from beamsplat.common.runtime.live import Live, LiveSettings
    from beamsplat.common.messages import Odometry
    from beamsplat.common.runtime.node import Job, Node, SourceItem

    class Worker(Node):
        name = "localization"
        inputs = ("external/pose",)
        outputs = ("localization/odometry",)

        def on_external_pose(self, pose):
            yield Job("long", lambda: (print("working", flush=True), time.sleep(60)), after=after)
            if after:
                yield Job("next", lambda: None, after=1)

        def on_job_long(self, result):
            return ()

        on_job_next = on_job_long

        def close(self):
            print("closed", flush=True)

    class Source(Node):
        name = "ros2"
        outputs = ("external/pose",)

        def source(self):
            print("speaks though nobody hears", flush=True)
            yield

    endpoint, folder, state, after = sys.argv[1], Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]) or None
    node = (Source if state == "consumers" else Worker)(Node.Config())
    live = Live(node, LiveSettings("test", (endpoint,), folder, wait_for=frozenset({"nobody"})))
    live.install_signal_handlers()
    print("started", flush=True)
    live.run()
    print("clean", flush=True)
"""


@pytest.fixture
def serve(tmp_path, free_endpoint):
    started = []

    def start(state, after=0):
        process = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(_SERVE), free_endpoint, tmp_path, state, str(after)],
            cwd=ROOT, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        started.append(process)
        assert process.stdout.readline() == "started\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()


def _ends(process):
    """Its last words, after SIGTERM; fails if it has to be killed."""
    process.send_signal(signal.SIGTERM)
    try:
        said, _ = process.communicate(timeout=8)
    except subprocess.TimeoutExpired:
        pytest.fail("does not end")
    assert process.returncode == 0
    return said


def test_while_waiting_for_a_router(serve):
    process = serve("router")
    time.sleep(1.0)
    assert "clean" in _ends(process)


def test_while_waiting_for_consumers(serve, free_endpoint):
    with open_router((free_endpoint,)):
        process = serve("consumers")
        time.sleep(2.0)
        assert _ends(process).split()[-1] == "clean"


@pytest.mark.parametrize("after", [0, 2])
def test_in_the_middle_of_a_long_background_job(serve, free_endpoint, after):
    """Also while the node itself waits for the job, which must be in before the next message."""
    with open_router((free_endpoint,)):
        process = serve("job", after)
        with Bus(open_session((free_endpoint,)), "test", "ros2", "ab" * 8, 1) as bus:
            poses = bus.publish("external/pose")
            deadline = time.monotonic() + 20
            while "localization" not in bus.alive_nodes() and time.monotonic() < deadline:
                time.sleep(0.1)
            for i in range(1, 4):
                poses.put(ExternalPose(stamp_ns=i, T_map_body=np.eye(4)))
                time.sleep(0.2)
            assert process.stdout.readline() == "working\n"
            assert _ends(process).split() == ["closed", "clean"]


_RUN = """
    import sys
    from pathlib import Path
    from beamsplat.common.config.deployment import Deployment, RouterConfig
    from beamsplat.services import nodes
    from beamsplat.tools.cli import system as system_cli
    from tests.common.nodes import TABLE

    nodes.NODES.clear()
    nodes.NODES.update(TABLE)
    slow = {"kind": "slow", "sleep_s": float(sys.argv[3])}
    system_cli.run_checked(Deployment(
        robot="test", router=RouterConfig(listen=(sys.argv[1],)), state_dir=Path(sys.argv[2]),
        nodes={"replay": {"kind": "drive", "seconds": 60.0}, "localization": slow},
    ))
"""


@pytest.mark.parametrize(("number", "sleep_s"), [(signal.SIGTERM, 0.0), (signal.SIGKILL, 300.0)])
def test_a_whole_system_whose_supervisor_is_ended(tmp_path, free_endpoint, number, sleep_s):
    """SIGTERM ends all in order. Even a supervisor killed outright leaves nothing, busy or not."""
    command = [sys.executable, "-c", textwrap.dedent(_RUN), free_endpoint, tmp_path, str(sleep_s)]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        with open_session((free_endpoint,), wait_s=30.0) as session:
            board = HealthTable(session, "test")
            _until(lambda: any(i.received for r in board.records.values() for i in r.health.inputs), 30)
        family = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
    finally:
        process.send_signal(number)
    assert process.wait(15) == (0 if number == signal.SIGTERM else -number)
    _, left = psutil.wait_procs(family, timeout=15)
    for orphan in left:
        orphan.kill()
    assert left == []


def test_a_router_that_was_asked_to_end_comes_back(tmp_path, free_endpoint):
    deployment = Deployment(robot="test", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path)
    with Supervisor(deployment, on_event=lambda text: None) as supervisor:
        first = supervisor.children["router"].process
        os.kill(first.pid, signal.SIGTERM)
        first.join(10)

        def back():
            supervisor.poll()
            return supervisor.children["router"].process.pid != first.pid

        _until(back, 10)


def _until(done, seconds):
    deadline = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < deadline, f"not within {seconds} s"
        time.sleep(0.05)
