"""Real processes on a real router: live equals lockstep, and what dies comes back."""

import os
import signal
import threading
import time

import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.errors import UserError
from beamsplat.common.messages.codec import encode
from beamsplat.common.runtime.live import Live, LiveSettings
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.common.zenoh.bus import Bus, open_session
from beamsplat.common.zenoh.queries import ask
from beamsplat.tools.system.assembly import node_classes, surroundings
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.nodes import TABLE, Chain, SensorSource, SensorSourceConfig, Sink
from tests.common.polling import poll


@pytest.fixture
def deployment(tmp_path, free_endpoint):
    def make(nodes, rate=0.0):
        return Deployment(
            robot="test",
            router=RouterConfig(listen=(free_endpoint,)),
            rate=rate,
            state_dir=tmp_path,
            nodes=nodes,
        )

    return make


class SinkThread:
    """A Sink on the bus, in a thread of the test."""

    def __init__(self, deployment):
        nodes = {**deployment.nodes, "recorder": {"kind": "sink"}}
        classes = node_classes(deployment.model_copy(update={"nodes": nodes}), TABLE)
        settings = LiveSettings(
            robot=deployment.robot,
            endpoints=deployment.router.listen,
            run_dir=deployment.run_dir,
            exit_when_drained=True,
            without_producer=surroundings(classes, "recorder").without_producer,
        )
        self.node = Sink(Sink.Config())
        self.live = Live(self.node, settings)
        self._thread = threading.Thread(target=self.live.run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exception):
        self.live.stop()
        self._thread.join(10)

    def join(self, timeout):
        self._thread.join(timeout)
        assert not self._thread.is_alive(), "the stream did not end"

    def stamps(self, topic):
        return [m.stamp_ns for t, m in list(self.node.seen) if t == topic]


@pytest.mark.parametrize("rate", [4.0, 0.0])
def test_live_equals_lockstep_message_for_message(deployment, rate):
    """The order in which packets arrive over the bus must not show in what a node says."""
    drive = {"seconds": 6.0, "image_bytes": 20_000}
    sink = Sink(Sink.Config())
    Lockstep([SensorSource(SensorSourceConfig(**drive)), Chain(Chain.Config()), sink]).run()
    nodes = {"replay": {"kind": "drive", **drive}, "localization": {"kind": "chain"}, "recorder": {}}
    live = deployment(nodes, rate=rate)
    with Supervisor(live, ("router", "localization"), table=TABLE), SinkThread(live) as thread:
        with Supervisor(live, ("replay",), table=TABLE):
            thread.join(30)
        for topic in ("localization/odometry", "localization/correction"):
            expected = [encode(m) for t, m in sink.seen if t == topic]
            received = [encode(m) for t, m in thread.node.seen if t == topic]
            assert received == expected, topic
        assert len(expected) > 5


def test_a_killed_node_comes_back_and_its_peers_go_on(deployment):
    nodes = {
        "replay": {"kind": "drive", "seconds": 60.0},
        "localization": {"kind": "chain"},
        "recorder": {"kind": "sink"},
    }
    live = deployment(nodes, rate=1.0)
    events = []
    with (
        Supervisor(live, table=TABLE, on_event=events.append) as supervisor,
        open_session(live.router.listen) as session,
        SinkThread(live) as thread,
    ):
        board = HealthTable(session, "test")
        poll(supervisor, lambda: len(thread.stamps("localization/odometry")) > 5, 30)
        peers = {n: c.process.pid for n, c in supervisor.children.items() if n != "localization"}
        first = supervisor.children["localization"].process.pid
        epoch = board.records["localization"].health.epoch
        os.kill(first, signal.SIGKILL)
        poll(supervisor, lambda: supervisor.children["localization"].process.pid != first, 2)  # spawned
        seen = len(thread.stamps("localization/odometry"))
        poll(supervisor, lambda: len(thread.stamps("localization/odometry")) > seen + 3, 10)  # ready
        poll(supervisor, lambda: board.records["localization"].health.epoch > epoch, 5)
        assert {n: c.process.pid for n, c in supervisor.children.items() if n != "localization"} == peers
        assert any("localization died (killed by SIGKILL" in e for e in events)


def test_a_killed_replay_goes_on_where_it_was(deployment):
    nodes = {"replay": {"kind": "drive", "seconds": 8.0, "images": False}, "localization": {"kind": "chain"}}
    live = deployment(nodes, rate=2.0)
    with SinkThreadLater(live) as later, Supervisor(live, table=TABLE) as supervisor:
        thread = later.start()
        poll(supervisor, lambda: len(thread.stamps("localization/odometry")) > 15, 30)
        os.kill(supervisor.children["replay"].process.pid, signal.SIGKILL)
        poll(supervisor, lambda: not thread._thread.is_alive(), 30)
        stamps = thread.stamps("localization/odometry")
    # The bookmark is at most 0.2 s of wall time old: at twice the speed, four scans may come twice.
    assert len(set(stamps)) >= 78
    assert len(stamps) <= 80 + 5


class SinkThreadLater:
    """Like SinkThread, started by hand once there is a router."""

    def __init__(self, deployment):
        self._deployment = deployment
        self._thread = None

    def __enter__(self):
        return self

    def start(self):
        self._thread = SinkThread(self._deployment).__enter__()
        return self._thread

    def __exit__(self, *exception):
        if self._thread:
            self._thread.__exit__()


def test_a_killed_router_is_replaced_and_everything_flows_again(deployment):
    nodes = {"replay": {"kind": "drive", "seconds": 60.0}, "localization": {"kind": "chain"}}
    live = deployment(nodes, rate=1.0)
    with SinkThreadLater(live) as later, Supervisor(live, table=TABLE) as supervisor:
        thread = later.start()
        poll(supervisor, lambda: len(thread.stamps("localization/odometry")) > 5, 30)
        nodes_before = {n: c.process.pid for n, c in supervisor.children.items() if n != "router"}
        router = supervisor.children["router"].process.pid
        os.kill(router, signal.SIGKILL)
        poll(supervisor, lambda: supervisor.children["router"].process.pid != router, 2)
        seen = len(thread.stamps("localization/odometry"))
        poll(supervisor, lambda: len(thread.stamps("localization/odometry")) > seen + 3, 5)
        assert nodes_before == {n: c.process.pid for n, c in supervisor.children.items() if n != "router"}

        # What was sent during the outage is recovered from the publishers' caches, in order, none missing.
        def complete():
            stamps = thread.stamps("localization/odometry")
            return set(range(stamps[0], stamps[-1] + 1, 100_000_000)) == set(stamps)

        poll(supervisor, complete, 5)


def test_a_slow_node_gets_the_newest_picture_and_every_scan(deployment):
    nodes = {
        "replay": {"kind": "drive", "seconds": 6.0, "image_bytes": 300_000},
        "localization": {"kind": "slow", "sleep_s": 0.2},
    }
    live = deployment(nodes, rate=1.0)
    with Supervisor(live, table=TABLE) as supervisor, open_session(live.router.listen) as session:
        board = HealthTable(session, "test")
        poll(supervisor, lambda: board.states().get("localization") == "drained", 40)
        health = {i.topic: i for i in board.records["localization"].health.inputs}
    assert 20 <= health["camera/image"].received <= 40  # 6 s at 5 Hz
    assert health["camera/image"].received + health["camera/image"].dropped >= 175  # of 180
    assert (health["lidar/scan"].received, health["lidar/scan"].lost) == (60, 0)


def test_broken_messages_are_counted_and_harm_nothing(deployment):
    live = deployment({"localization": {"kind": "chain"}})
    with Supervisor(live, table=TABLE) as supervisor, open_session(live.router.listen) as session:
        board = HealthTable(session, "test")
        poll(supervisor, lambda: board.states().get("localization") == "active", 30)
        for payload, attachment in ((b"rubbish", None), (b"rubbish", b"short"), (b"", b"x" * 80)):
            session.put("beamsplat/test/lidar/scan", payload, attachment=attachment)
        publication = Bus(session, "test", "replay", "ab" * 8, 1).publish("wheel/odometry")
        session.put("beamsplat/test/wheel/odometry", b"\x00" * 64, attachment=b"BS")
        assert publication.sent == 0

        def counted():
            inputs = {i.topic: i for i in board.records["localization"].health.inputs}
            return inputs["lidar/scan"].undecodable == 3 and inputs["wheel/odometry"].undecodable == 1

        poll(supervisor, counted, 5)
        assert supervisor.children["localization"].process.is_alive()


def test_queries_are_answered_by_the_node(deployment):
    live = deployment({"localization": {"kind": "chain"}})
    with Supervisor(live, table=TABLE) as supervisor, open_session(live.router.listen) as session:
        board = HealthTable(session, "test")
        poll(supervisor, lambda: board.states().get("localization") == "active", 30)
        replies = list(ask(session, "test", "localization", "count", {"add": "41"}, 5.0))
        assert [r.optimisation for r in replies] == [41]
        with pytest.raises(UserError, match="rejected count: invalid literal"):
            list(ask(session, "test", "localization", "count", {"add": "much"}, 5.0))
        assert [r.optimisation for r in ask(session, "test", "localization", "count", {}, 5.0)] == [
            0
        ]  # it lives
        with pytest.raises(UserError, match="no answer from node"):
            list(ask(session, "test", "depth", "count", {}, 5.0))


def test_processes_end_at_sigterm_and_leave_nothing_behind(deployment):
    live = deployment({"localization": {"kind": "chain"}})
    with Supervisor(live, table=TABLE) as supervisor:
        pids = [c.process.pid for c in supervisor.children.values()]
        started = time.monotonic()
    assert time.monotonic() - started < 5.0, "somebody had to be killed"
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
