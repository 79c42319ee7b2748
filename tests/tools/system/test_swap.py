"""Swapping a node under load, with real processes: no stamp twice, none lost, and failures change nothing."""

import itertools
import json
import os
import signal
import threading
import time
from urllib.parse import quote

import numpy as np
import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.errors import UserError
from beamsplat.common.messages import Odometry
from beamsplat.common.runtime.node import Node
from beamsplat.common.runtime.registry import Service
from beamsplat.common.zenoh.bus import open_session
from beamsplat.common.zenoh.queries import OPERATOR_QUERY, ask, command
from beamsplat.tools.system.commands import Commands
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.nodes import TABLE, SlowConfig
from tests.common.topic_listener import TopicListener


class Swift(Node):
    """A pose for every scan; keeps nothing for long."""

    name = "localization"
    Config = SlowConfig
    inputs = ("lidar/scan",)
    outputs = ("localization/odometry",)
    replaceable = True

    def configure(self):
        if self.config.sleep_s > 1.0:
            raise UserError("a step of more than a second: no")

    def on_lidar_scan(self, scan):
        time.sleep(self.config.sleep_s)
        yield (
            "localization/odometry",
            Odometry(stamp_ns=scan.stamp_ns, T_odom_body=np.eye(4), covariance=np.eye(3)),
        )


_TABLE = {
    **TABLE,
    "localization": Service("localization", "", {"swift": "tests.tools.system.test_swap:Swift", "chain": "tests.common.nodes:Chain", "answering": "tests.tools.system.answering:Answering"}),
}  # fmt: skip


class System:
    """A supervisor with its commands, attended to in a thread, as `beamsplat run` does."""

    def __init__(self, tmp_path, endpoint, nodes, rate=1.0, table=_TABLE):
        self._table = table
        self.deployment = Deployment(
            robot="r1", router=RouterConfig(listen=(endpoint,)), rate=rate, state_dir=tmp_path, nodes=nodes
        )
        self._stop = threading.Event()

    def __enter__(self):
        self.supervisor = Supervisor(self.deployment, table=self._table).__enter__()
        self.session = open_session(self.deployment.router.listen)
        self.board = HealthTable(self.session, "r1")
        self._commands = Commands(self.session, "r1", self.supervisor)
        self._thread = threading.Thread(target=self._attend)
        self._thread.start()
        self.asker = open_session(self.deployment.router.listen)
        return self

    def _attend(self):
        while not self._stop.wait(0.05):
            self._commands.answer_pending()
            self.supervisor.poll()

    def __exit__(self, *exception):
        self._stop.set()
        self._thread.join()
        self.asker.close()
        self.session.close()
        self.supervisor.__exit__()

    def ask(self, node, verb, **parameters):
        (answer,) = ask(self.asker, "r1", node, verb, parameters, 60.0, OPERATOR_QUERY)
        return answer.text

    def swap(self, node, *changes, **more):
        return self.ask(node, "swap", set=quote(json.dumps(changes)), **more)

    def wait(self, until, timeout_s=30.0):
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            if until():
                return
            time.sleep(0.05)
        raise AssertionError(f"not within {timeout_s} s")


NODES = {
    "replay": {"kind": "drive", "seconds": 300.0, "images": False},
    "localization": {"kind": "swift", "sleep_s": 0.01},
}


@pytest.fixture
def system(tmp_path, free_endpoint):
    with System(tmp_path, free_endpoint, NODES) as made:
        yield made


@pytest.mark.slow
def test_swaps_under_load_say_nothing_twice_and_lose_nothing(system):
    ears = TopicListener(system.session, "localization/odometry")
    system.wait(lambda: len(ears.messages) > 20)
    instances = {system.supervisor.children["localization"].instance}
    for number in range(4):
        text = system.swap("localization", f"sleep_s={0.005 + 0.001 * number}")
        assert "was taken over" in text
        before = len(ears.messages)
        system.wait(lambda before=before: len(ears.messages) > before + 10)
        instances.add(system.supervisor.children["localization"].instance)
    assert len(instances) == 5
    stamps = ears.stamps()
    assert stamps == sorted(set(stamps)), "a stamp came twice, or late"
    assert {b - a for a, b in itertools.pairwise(stamps)} == {100_000_000}, "a scan has no pose"
    assert json.loads(system.ask("localization", "params"))["sleep_s"] == 0.008
    system.wait(lambda: system.board.records["localization"].health.epoch >= 5)


@pytest.mark.slow
def test_a_successor_that_cannot_run_changes_nothing(system):
    ears = TopicListener(system.session, "localization/odometry")
    system.wait(lambda: len(ears.messages) > 5)
    before = system.supervisor.children["localization"].instance
    with pytest.raises(UserError, match="more than a second"):
        system.swap("localization", "sleep_s=2.0")
    with pytest.raises(UserError, match="unknown option 'slep_s'"):
        system.swap("localization", "slep_s=2.0")
    with pytest.raises(UserError, match="--cold"):
        system.swap("replay", "seconds=3.0")
    with pytest.raises(UserError, match="JSON list"):
        system.ask("localization", "swap", set=quote('{"a": 1}'))
    with pytest.raises(UserError, match="no answer from node"):
        system.ask("depth", "swap")
    assert system.supervisor.children["localization"].instance == before
    for verb in ("activate", "dance"):  # it is not in standby; it knows no such request
        with pytest.raises(UserError, match=f"cannot answer the request '{verb}'"):
            command(system.asker, "r1", ("localization", before), verb, {"after": "{}"}, 5.0)
    assert json.loads(system.ask("localization", "params"))["sleep_s"] == 0.01
    count = len(ears.messages)
    system.wait(lambda: len(ears.messages) > count + 5)


@pytest.mark.slow
def test_after_a_swap_a_crash_brings_back_the_new_options_and_a_cold_swap_starts_anew(system):
    ears = TopicListener(system.session, "localization/odometry")
    system.wait(lambda: len(ears.messages) > 5)
    system.swap("localization", "sleep_s=0.02")
    os.kill(system.supervisor.children["localization"].process.pid, signal.SIGKILL)
    system.wait(lambda: system.supervisor.children["localization"].restarts == 1)
    assert json.loads(system.ask("localization", "params"))["sleep_s"] == 0.02
    count = len(ears.messages)
    system.wait(lambda: len(ears.messages) > count + 5)
    assert "starts again with the new options" in system.swap("localization", "kind=chain", cold="1")
    system.wait(lambda: system.supervisor.children["localization"].restarts == 2)
    assert json.loads(system.ask("localization", "params"))["kind"] == "chain"


def test_a_restart_by_request_still_works(system):
    ears = TopicListener(system.session, "localization/odometry")
    system.wait(lambda: len(ears.messages) > 5)
    assert "starts again" in system.ask("localization", "restart")
    system.wait(lambda: system.supervisor.children["localization"].restarts == 1)


@pytest.mark.parametrize("answer", ["text", "a list", "another message", "an unknown message"])
@pytest.mark.parametrize("verb", ["reached", "retire", "activate"])
def test_an_unexpected_answer_of_a_process_fails_the_swap_and_not_the_supervisor(
    tmp_path, free_endpoint, verb, answer
):
    odd = {"kind": "answering", "verb": verb, "answer": answer}
    with System(tmp_path, free_endpoint, {**NODES, "localization": odd}) as system:
        ears = TopicListener(system.session, "localization/odometry")
        system.wait(lambda: len(ears.messages) > 5)
        with pytest.raises(UserError, match=f"answered {verb} with") as refused:
            system.swap("localization", "threads=2")
        assert "localization" in str(refused.value)
        count = len(ears.messages)
        system.wait(lambda: len(ears.messages) > count + 5)
        assert json.loads(system.ask("localization", "params"))["verb"] == verb, "the supervisor has ended"


def test_other_nodes_are_restarted_while_a_predecessor_is_in_a_long_step(tmp_path, free_endpoint):
    nodes = {**NODES, "localization": {"kind": "answering", "sleep_s": 6.0}, "recorder": {"kind": "sink"}}
    with System(tmp_path, free_endpoint, nodes) as system:
        system.wait(lambda: {"recorder", "localization"} <= set(system.board.states()))
        system.wait(lambda: system.board.records["localization"].health.inputs[0].received > 0)
        done = threading.Thread(target=system.swap, args=("localization", "sleep_s=0.0"))
        done.start()
        predecessor = system.supervisor.children["localization"]
        system.wait(lambda: getattr(predecessor, "retiring", True))
        recorder = system.supervisor.children["recorder"]
        os.kill(recorder.process.pid, signal.SIGKILL)
        system.wait(lambda: recorder.restarts == 1)
        assert done.is_alive(), "the supervisor waited for the predecessor"
        done.join(60)
