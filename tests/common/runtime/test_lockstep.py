"""The lockstep runner: the same messages every time, including the dropped ones."""

import hashlib

import pytest

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.messages.codec import encode
from beamsplat.common.runtime.lockstep import Lockstep
from tests.common.nodes import Chain, SensorSource, SensorSourceConfig, Sink, Slow, SlowConfig


def _run(*nodes):
    digest, envelopes = hashlib.sha256(), []

    def on_message(envelope):
        digest.update(envelope.topic.encode() + encode(envelope.message))
        envelopes.append(envelope)

    mailboxes = Lockstep(list(nodes), on_message).run()
    return digest.hexdigest(), envelopes, mailboxes


def test_the_same_input_gives_the_same_bytes():
    runs = [
        _run(SensorSource(SensorSourceConfig()), Chain(Chain.Config()), Sink(Sink.Config())) for _ in range(2)
    ]
    assert runs[0][0] == runs[1][0]
    other = _run(SensorSource(SensorSourceConfig(seed=1)), Chain(Chain.Config()), Sink(Sink.Config()))
    assert other[0] != runs[0][0]
    topics = [envelope.topic for envelope in runs[0][1]]
    assert topics.count("localization/odometry") == 30
    assert topics.count("localization/correction") > 2  # results of the background jobs


def test_modelled_cost_drops_latest_messages_reproducibly():
    runs = []
    for _ in range(2):
        slow, sink = Slow(SlowConfig(step_cost_s=0.2)), Sink(Sink.Config())
        runs.append(_run(SensorSource(SensorSourceConfig()), slow, sink))
    assert runs[0][0] == runs[1][0]
    count = runs[0][2]["localization"].counts["camera/image"]
    assert count.received + count.dropped == 90
    assert count.dropped > 60  # 30 Hz of images, of which at most 5 per second are handled
    assert runs[0][2]["localization"].counts["lidar/scan"].dropped == 0


def test_no_cost_drops_nothing():
    slow = Slow(SlowConfig())
    _, envelopes, mailboxes = _run(SensorSource(SensorSourceConfig()), slow, Sink(Sink.Config()))
    assert mailboxes["localization"].counts["camera/image"].dropped == 0
    assert sum(envelope.topic == "localization/grid" for envelope in envelopes) == 90


class Postponing(Chain):
    """Owes three pieces of work per scan, and notes when it does them."""

    def configure(self):
        super().configure()
        self.owed, self.done, self.scans = 0, [], 0

    def on_lidar_scan(self, message):
        self.owed += 3
        self.scans += 1
        yield from super().on_lidar_scan(message)

    def has_idle_work(self):
        return self.owed > 0

    def on_idle(self):
        self.owed -= 1
        self.done.append(self.scans)
        return ()


def test_work_that_can_wait_is_done_between_messages_as_its_modelled_duration_allows():
    quick, slow, slower = (Postponing(NodeConfig(idle_cost_s=s)) for s in (0.0, 0.02, 0.2))
    for node in (quick, slow, slower):
        _run(SensorSource(SensorSourceConfig(images=False)), node, Sink(Sink.Config()))
    expected = [k for k in range(1, 31) for _ in range(3)]
    assert quick.done == expected
    assert slow.done == expected[: len(slow.done)]
    assert len(slow.done) >= 3 * 29  # what is left when the inputs end is for `drain`
    assert 10 < len(slower.done) < 18  # one piece each 0.2 s
    assert slower.owed == 90 - len(slower.done)
    assert slower.done == sorted(slower.done)


def test_inputs_that_a_node_ignores_are_not_delivered_and_not_waited_for():
    class WithoutWheels(Chain):
        def ignored_inputs(self):
            return frozenset({"wheel/odometry"})

        def on_wheel_odometry(self, message):
            raise AssertionError("not subscribed")

    _, envelopes, mailboxes = _run(SensorSource(SensorSourceConfig()), WithoutWheels(WithoutWheels.Config()))
    assert mailboxes["localization"].counts["wheel/odometry"].received == 0
    assert sum(envelope.topic == "localization/odometry" for envelope in envelopes) == 30


def test_messages_reach_a_node_in_order_of_their_stamps():
    order = []

    class Watcher(Chain):
        def on_wheel_odometry(self, message):
            order.append(message.stamp_ns)
            return super().on_wheel_odometry(message)

        def on_lidar_scan(self, message):
            order.append(message.stamp_ns)
            yield from super().on_lidar_scan(message)

    _run(SensorSource(SensorSourceConfig()), Watcher(Watcher.Config()))
    assert len(order) == 150 + 30
    assert order == sorted(order)


def test_all_nodes_are_closed_when_one_cannot_be_configured():
    closed = []

    class Closing(Sink):
        def close(self):
            closed.append("sink")

    class Broken(Chain):
        def configure(self):
            raise ValueError("no weights")

    with pytest.raises(ValueError, match="no weights"):
        _run(Closing(Closing.Config()), Broken(Broken.Config()))
    assert closed == ["sink"]


def test_a_topic_without_a_producer_is_not_waited_for():
    envelopes = _run(SensorSource(SensorSourceConfig(scans=False)), Chain(Chain.Config()))[1]
    assert sum(envelope.topic == "wheel/odometry" for envelope in envelopes) == 150
