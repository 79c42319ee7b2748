"""Nodes that share a process: each with its own identity and health; a failure of one ends and restarts all."""

import os
import re
import signal

import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig, load_deployment
from beamsplat.common.errors import UserError
from beamsplat.common.runtime.registry import Service
from beamsplat.common.zenoh.bus import open_session
from beamsplat.tools.system.assembly import faults
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.nodes import TABLE
from tests.common.polling import poll
from tests.common.topic_listener import TopicListener
from tests.tools.system.failing import FAILS_AFTER_NS

ODOMETRY = "localization/odometry"
TOGETHER = ("localization", "recorder")
REPLAY = {"kind": "drive", "seconds": 300.0, "images": False}
KINDS = {"swift": "tests.tools.system.test_swap:Swift", "failing": "tests.tools.system.failing:Failing"}
OWN_TABLE = {**TABLE, "localization": Service("localization", "", KINDS)}


def deployment(tmp_path, endpoint, **localization):
    return Deployment(
        robot="r1", router=RouterConfig(listen=(endpoint,)), state_dir=tmp_path, together=TOGETHER,
        nodes={"replay": REPLAY, "localization": localization, "recorder": {"kind": "sink"}},
    )  # fmt: skip


class Run:
    """A supervised system, with the health of its nodes."""

    def __init__(self, system, session):
        self.supervisor, self.events = system, []
        self.board = HealthTable(session, "r1")

    def child(self, name):
        return self.supervisor.children[name]

    def reported(self, name):
        """Return the instance of a node that reports to be active, else ""."""
        self.supervisor.observe(self.board.reported())
        instance, state = self.board.reported().get(name, ("", ""))
        return instance if state == "active" else ""

    def all_active(self):
        return all(self.reported(name) == self.child(name).instance for name in ("replay", *TOGETHER))


@pytest.fixture
def start(tmp_path, free_endpoint):
    """Return a function that starts the system; it is stopped after the test."""
    started = []

    def begin(**localization):
        events = []
        system = Supervisor(
            deployment(tmp_path, free_endpoint, **localization), table=OWN_TABLE, on_event=events.append
        )
        started.append(system.__enter__())
        started.append(open_session((free_endpoint,)))
        run = Run(system, started[-1])
        run.events = events
        run.session = started[-1]
        return run

    yield begin
    if started:
        started[1].close()
        started[0].__exit__()


def test_nodes_of_one_process_have_their_own_identity_and_a_crash_restarts_all_of_them(start):
    run = start(kind="swift")
    poses = TopicListener(run.session, ODOMETRY)
    poll(run.supervisor, lambda: run.all_active() and len(poses.messages) > 3, 60.0)
    first = {name: run.child(name) for name in TOGETHER}
    pids = {entry.process.pid for entry in first.values()}
    instances = {entry.instance for entry in first.values()}
    assert len(pids) == 1
    assert run.child("replay").process.pid not in pids
    assert len(instances) == 2
    memory = {name: record.health.rss_mb for name, record in run.board.records.items()}
    assert memory["localization"] == pytest.approx(memory["recorder"], rel=0.2)  # half of the process each
    with pytest.raises(UserError, match=r"localization shares the process localization\+recorder: --cold"):
        run.supervisor.successor("localization", ("sleep_s=0.02",), warm=True)
    os.kill(pids.pop(), signal.SIGKILL)
    poll(run.supervisor, lambda: {run.child(n).restarts for n in TOGETHER} == {1}, 30.0)
    count = len(poses.messages)
    poll(run.supervisor, lambda: run.all_active() and len(poses.messages) > count + 3, 60.0)
    assert not instances & {run.child(name).instance for name in TOGETHER}
    assert sum("died" in event for event in run.events) == 1
    assert run.child("replay").restarts == 0
    assert (run.supervisor.log_dir / "localization+recorder.log").exists()
    assert run.supervisor.log_file("recorder").name == "localization+recorder.log"
    run.supervisor.restart_with(run.supervisor.successor("localization", ("sleep_s=0.02",), warm=False))
    poll(run.supervisor, lambda: {run.child(n).restarts for n in TOGETHER} == {2}, 30.0)
    poll(run.supervisor, run.all_active, 60.0)


def test_a_node_that_cannot_run_is_the_reason_shown_for_all_nodes_of_its_process(start, tmp_path):
    file = tmp_path / "map"
    file.touch()
    run = start(kind="failing", needs=str(file))
    poses = TopicListener(run.session, ODOMETRY)
    poll(run.supervisor, lambda: run.all_active() and max(poses.stamps(), default=0) > FAILS_AFTER_NS, 60.0)
    file.unlink()
    poll(run.supervisor, lambda: run.child("recorder").failed, 30.0)
    assert run.child("localization").failed == run.child("recorder").failed
    assert f"localization: {file} has gone" in run.child("recorder").failed
    assert sum("cannot run" in event for event in run.events) == 1
    assert run.supervisor.obstacle == ""
    file.touch()
    poll(run.supervisor, lambda: run.all_active() and not run.child("localization").failed, 60.0)


@pytest.mark.parametrize(
    ("together", "text"),
    [
        (
            ("localization", "depth"),
            "together: the deployment has no node 'depth'; it has replay, localization",
        ),
        (("localization", "localization"), "together: 'localization' is named twice"),
        (("localization",), r"together = \['localization'\]: name at least two nodes"),
    ],
)
def test_errors_in_the_list_are_found_before_the_start(together, text):
    nodes = {"replay": REPLAY, "localization": {"kind": "chain"}}
    (fault,) = faults(Deployment(nodes=nodes, together=together), TABLE)
    assert fault.fatal
    assert re.match(text, fault.text)


def test_the_list_can_be_set_on_the_command_line(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text("[nodes.depth]\n[nodes.fusion]\n[nodes.keyframes]\n")
    loaded = load_deployment(file, ('together=["depth", "fusion", "keyframes"]',))
    assert loaded.sharing("fusion") == ("depth", "fusion", "keyframes")
    assert loaded.sharing("mapping") == ("mapping",)
