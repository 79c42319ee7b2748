"""The bridge between a robot's router and an edge server's: what the topic table marks crosses, the rest does not."""

import contextlib
import dataclasses
import itertools
import time

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import make_transform, so3_exp
from beamsplat.common.messages import Health, HealthBundle, Odometry
from beamsplat.common.messages.codec import encode
from beamsplat.common.messages.header import Header
from beamsplat.common.messages.health_codec import pack_reports
from beamsplat.common.runtime.mailbox import Mailbox
from beamsplat.common.runtime.node import Node
from beamsplat.common.topics import TOPICS
from beamsplat.common.zenoh.bridge import Bridge, BridgeSessions
from beamsplat.common.zenoh.bus import Bus, open_router, open_session
from beamsplat.common.zenoh.health_samples import BUNDLE_ENCODING
from beamsplat.common.zenoh.streams import declare_subscription, decode_sample
from beamsplat.tools.system.health_table import HealthTable
from tests.common.messages.test_health_codec import robot_reports
from tests.common.polling import wait_until
from tests.common.samples import sample_messages
from tests.conftest import free_port

SAMPLES = {type(m): m for m in sample_messages()}
UP = {name for name, row in TOPICS.items() if row.uplink in ("up", "bulk")}
DOWN = {name for name, row in TOPICS.items() if row.uplink == "down"}
AT_ROBOT, AT_EDGE = "aa" * 8, "bb" * 8  # instances of the producers of the two sides


class _EdgePage(Node):
    name = "page"
    inputs = ("localization/odometry",)

    def on_localization_odometry(self, message):
        return iter(())


class Side:
    """A router with one producer of all topics, and the keys that are received there from the other side."""

    def __init__(self, stack, instance):
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        stack.enter_context(open_router((self.endpoint,)))
        self.instance, self._stack = instance, stack
        self.bus = Bus(self.open(), "r1", "producer", instance, 1)
        self.publications = {name: self.bus.publish(name) for name in TOPICS}
        self.crossed = set()
        self._kept = self.open().declare_subscriber("beamsplat/**", self._hear)

    def open(self):
        return self._stack.enter_context(open_session((self.endpoint,)))

    def _hear(self, sample):
        if Header.unpack(sample.attachment.to_bytes()).instance != self.instance:
            self.crossed.add(str(sample.key_expr).removeprefix("beamsplat/r1/"))

    def publish(self, names):
        for name in names:
            self.publications[name].put(SAMPLES[TOPICS[name].message])


@pytest.fixture
def sides():
    with contextlib.ExitStack() as stack:
        robot, edge = Side(stack, AT_ROBOT), Side(stack, AT_EDGE)
        sessions = BridgeSessions(robot=robot.open(), edge=edge.open(), edge_bulk=edge.open())
        yield robot, edge, Bridge("r1", sessions), sessions


def test_marked_topics_cross_in_their_direction_and_no_others(sides):
    robot, edge, bridge, _ = sides

    def all_crossed():
        robot.publish(TOPICS)  # the unmarked ones too, and each before the last marked one
        edge.publish(TOPICS)
        return edge.crossed >= UP and robot.crossed >= DOWN

    wait_until(all_crossed, 10.0)
    assert edge.crossed == UP
    assert robot.crossed == DOWN
    assert set(bridge.forwarded_up()) == UP
    for name in UP | DOWN:
        assert bridge.forwarded[name].messages > 0
        assert bridge.forwarded[name].bytes > 0
    assert bridge.ended == set()
    assert bridge.interrupted == 0


def test_ends_and_health_cross(sides):
    robot, edge, bridge, _ = sides
    for name in ("tick", "wheel/odometry"):
        robot.bus.end(robot.publications[name])
    edge.bus.end(edge.publications["keyframes/ack"])

    def crossed():
        robot.bus.publish_health(SAMPLES[Health])
        edge.bus.publish_health(SAMPLES[Health])
        return {"end/tick", "health/bundle"} <= edge.crossed and "health/bundle" in robot.crossed

    wait_until(crossed)
    wait_until(lambda: bridge.ended == {"tick", "keyframes/ack"})
    assert edge.crossed == {"end/tick", "health/bundle"}
    wait_until(lambda: robot.crossed == {"end/keyframes/ack", "health/bundle"})


def test_reports_of_a_side_cross_together_and_a_change_of_state_at_once(sides):
    robot, edge, bridge, _ = sides
    table = HealthTable(edge.open(), "r1")
    reports = {name: _report(name) for name in ("camera", "depth", "fusion")}
    nodes = {name: Bus(robot.open(), "r1", name, AT_ROBOT, 1) for name in reports}

    def arrived():
        for name, bus in nodes.items():
            bus.publish_health(reports[name])
        return table.states() == dict.fromkeys(reports, "active")

    wait_until(arrived)
    count = bridge.forwarded["health"]
    before = count.messages
    for _ in range(5):  # within less than a second, unless the machine is very busy
        arrived()
    wait_until(lambda: count.messages > before)
    assert count.messages - before < 15
    nodes["depth"].publish_health(reports["depth"].model_copy(update={"state": "drained"}))
    wait_until(lambda: table.states()["depth"] == "drained")
    assert table.records["fusion"].health.figures == reports["fusion"].figures


def _report(node):
    return SAMPLES[Health].model_copy(update={"node": node, "instance": AT_ROBOT, "epoch": 1})


def test_a_robot_at_rest_needs_less_than_two_kilobytes_a_second(sides):
    robot, edge, bridge, _ = sides
    table = HealthTable(edge.open(), "r1")
    nodes = [Bus(robot.open(), "r1", report.node, AT_ROBOT, 1) for report in robot_reports()]

    def one_second(number):
        for node, report in zip(nodes, robot_reports(number)):  # all counters and measurements change
            node.publish_health(report.model_copy(update={"instance": AT_ROBOT}))
        for tenth in range(10):
            stamp_ns = number * 1_000_000_000 + tenth * 100_000_000
            update = {"stamp_ns": stamp_ns, "T_odom_body": np.eye(4)}
            robot.publications["localization/odometry"].put(SAMPLES[Odometry].model_copy(update=update))
        robot.publications["tick"].put(SAMPLES[TOPICS["tick"].message])
        time.sleep(1.0)

    def sent_bytes():
        return sum(traffic.bytes for traffic in bridge.forwarded.values())

    numbers = itertools.count(1)
    wait_until(lambda: one_second(next(numbers)) or len(table.states()) == len(nodes), 20.0)
    before = sent_bytes()
    for _ in range(3):
        one_second(next(numbers))
    assert 3 * 500 < sent_bytes() - before < 3 * 2000
    assert set(table.states().values()) == {"active"}


def test_a_node_cannot_report_the_health_of_others(sides):
    robot, edge, _, _ = sides
    table = HealthTable(edge.open(), "r1")
    bundle = HealthBundle(stamp_ns=1, packed=pack_reports([_report("fusion")]))
    header, node = (
        Header(1, 1, 1, 0, 1, "depth", AT_ROBOT).pack(),
        Bus(robot.open(), "r1", "depth", AT_ROBOT, 1),
    )
    kept = edge.open()

    def refused():
        for session in (kept, node.session):  # beside the bridge, and through it
            session.put(
                "beamsplat/r1/health/depth", encode(bundle), encoding=BUNDLE_ENCODING, attachment=header
            )
        node.publish_health(_report("depth"))
        return "depth" in table.records and table._undecodable

    wait_until(refused)
    assert set(table.records) == {"depth"}


def test_a_latched_message_of_before_the_bridge_crosses():
    with contextlib.ExitStack() as stack:
        robot, edge = Side(stack, AT_ROBOT), Side(stack, AT_EDGE)
        robot.publish(["rig"])
        sessions = BridgeSessions(robot=robot.open(), edge=edge.open(), edge_bulk=edge.open())
        bridge = Bridge("r1", sessions)
        wait_until(lambda: "rig" in edge.crossed)
        assert bridge.forwarded["rig"].messages == 1


def test_tiles_of_before_the_bridge_reach_a_viewer_at_the_edge_that_joins_late():
    row = TOPICS["localization/grid"]
    sent = [SAMPLES[row.message].model_copy(update={"row": number}) for number in range(40)]
    with contextlib.ExitStack() as stack:
        robot, edge = Side(stack, AT_ROBOT), Side(stack, AT_EDGE)
        for tile in sent:
            robot.publications[row.name].put(tile)
        bridge = Bridge("r1", BridgeSessions(robot=robot.open(), edge=edge.open(), edge_bulk=edge.open()))
        wait_until(lambda: bridge.forwarded[row.name].messages == 40, 10.0)
        rows = []
        _kept = declare_subscription(
            edge.open(), f"beamsplat/r1/{row.name}", row, "every",
            lambda sample: rows.append(decode_sample(sample, row).message.row),
        )  # fmt: skip
        wait_until(lambda: rows == list(range(40)))


def test_a_new_session_forwards_the_large_messages_alone(sides):
    robot, edge, bridge, sessions = sides
    wait_until(lambda: robot.publish(["keyframes/frame"]) or "keyframes/frame" in edge.crossed)
    replacement = BridgeSessions(robot=sessions.robot, edge=sessions.edge, edge_bulk=edge.open())
    bridge.replace_bulk_session(replacement)
    sessions.edge_bulk.close()
    edge.crossed.clear()
    wait_until(lambda: robot.publish(["keyframes/frame"]) or "keyframes/frame" in edge.crossed)
    assert bridge.interrupted == 0


def test_another_robots_topics_do_not_cross(sides):
    robot, edge, _, _ = sides
    other = Bus(robot.open(), "r2", "clock", "cc" * 8, 1).publish("tick")
    received = []
    kept = edge.open().declare_subscriber("beamsplat/r2/**", lambda s: received.append(s))

    def own_crossed():
        other.put(SAMPLES[TOPICS["tick"].message])
        robot.publish(["tick"])
        return "tick" in edge.crossed

    wait_until(own_crossed)
    assert received == []
    kept.undeclare()


def pose(number, x_m=0.0, yaw_rad=0.0, status="ok"):
    """Return the pose number `number` of a stream at 10 Hz."""
    T = make_transform(so3_exp([0.0, 0.0, yaw_rad]), np.array([x_m, 0.0, 0.0]))
    return Odometry(stamp_ns=10**18 + number * 10**8, T_odom_body=T, covariance=np.eye(3), status=status)


def test_of_a_robot_that_stands_still_one_pose_per_second_crosses(sides):
    robot, edge, bridge, _ = sides
    row = TOPICS["localization/odometry"]
    now_ns, stamps = [1], []
    mailbox = Mailbox(_EdgePage, lambda: now_ns[0])

    def take(sample):
        envelope = decode_sample(sample, row)
        # Here the clocks of both sides are the same: the header of a robot has another one.
        header = dataclasses.replace(envelope.header, clock_id=1)
        mailbox.put(dataclasses.replace(envelope, header=header))
        stamps.append((envelope.message.stamp_ns - 10**18) // 10**8)

    _kept = declare_subscription(edge.open(), f"beamsplat/r1/{row.name}", row, "every", take)
    publication = robot.publications[row.name]
    # Each of these differs from the one before: the first ones may be sent before the subscription is known.
    here_or_there_m = itertools.cycle((0.0, 1.0))
    wait_until(lambda: publication.put(pose(0, next(here_or_there_m), status="lost")) and stamps)
    noise = np.random.default_rng(1).normal(0.0, 0.001, (60, 2))
    for number in range(1, 61):  # six seconds at rest
        publication.put(pose(number, *noise[number - 1]))
    for number in range(61, 81):  # then two seconds at 0.3 m/s
        publication.put(pose(number, 0.03 * (number - 60)))
    wait_until(lambda: 80 in stamps)
    for number in range(81, 84):
        publication.put(pose(number, 0.6))
    robot.bus.end(publication)
    wait_until(lambda: row.name in bridge.ended)
    wait_until(lambda: 83 in stamps)  # the last one before the end crosses in any case
    expected = [1, 11, 21, 31, 41, 51, *range(61, 81)]
    assert [stamp for stamp in stamps if stamp > 0][: len(expected)] == expected
    at_rest_bytes_per_s = bridge.forwarded[row.name].bytes / bridge.forwarded[row.name].messages
    assert at_rest_bytes_per_s < 1000
    now_ns[0] += 60 * 10**9  # what is missing does not count as lost later either
    (health,) = mailbox.health()
    assert health.lost == 0
    assert health.dropped > 50


def test_garbage_neither_crosses_nor_ends_a_topic(sides):
    robot, edge, bridge, _ = sides
    kept = robot.open()
    garbage = {"end/tick": 0, "tick": 0, "health/producer": 0}

    def all_refused():
        for name in garbage:
            kept.put(f"beamsplat/r1/{name}", b"rubbish")
            kept.put(f"beamsplat/r1/{name}", b"rubbish", attachment=b"BS")
        return bridge.undecodable >= 3 * len(garbage)

    wait_until(all_refused)
    assert bridge.ended == set()
    assert bridge.forwarded["tick"].messages == 0
    wait_until(lambda: robot.publish(["tick"]) or edge.crossed == {"tick"})


def test_a_topic_is_not_ended_any_more_when_a_new_process_publishes_on_it(sides):
    robot, _, bridge, _ = sides
    robot.publish(["tick"])
    robot.bus.end(robot.publications["tick"])
    wait_until(lambda: bridge.ended == {"tick"})
    successor = Bus(robot.open(), "r1", "producer", "cc" * 8, 2).publish("tick")
    wait_until(lambda: successor.put(SAMPLES[TOPICS["tick"].message]) and not bridge.ended)
