"""SIGTERM ends a process soon, in whatever state it is."""

import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from common.bus import Bus, open_router, open_session
from common.messages import ExternalPose

ROOT = Path(__file__).resolve().parents[2]

_SERVE = """
    import sys, time
    from pathlib import Path
    import numpy as np
    from common.live import Live, LiveSettings
    from common.messages import Odometry
    from common.node import Job, Node, Sourced

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
