"""The bus between two sessions of a router: messages with headers, undecodable ones, ends, tokens, queries."""

import time

import pytest

from beamsplat.common.messages import Health, Tick
from beamsplat.common.messages.codec import encode, schema_of
from beamsplat.common.messages.header import Header, local_clock_id
from beamsplat.common.messages.instances import control_id
from beamsplat.common.runtime.node import Input
from beamsplat.common.topics import topic
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.streams import ENCODING
from tests.common.polling import publish_until_received, wait_until
from tests.common.samples import assert_equal, sample_messages

SAMPLES = {type(m): m for m in sample_messages()}


class Received:
    """What one subscription has received."""

    def __init__(self, bus, topic_name):
        self.envelopes, self.undecodable, self.ends = [], [], []
        bus.subscribe(
            Input(topic_name),
            self.envelopes.append,
            lambda *fault: self.undecodable.append(fault),
            lambda topic, header, sent: self.ends.append((topic, header.instance, header.epoch, sent)),
        )

    def sequences(self):
        return [envelope.header.sequence for envelope in self.envelopes]


def test_a_message_arrives_with_its_header_and_size(make_bus):
    producer, consumer = make_bus("clock", epoch=7), make_bus("monitor")
    received, publication = Received(consumer, "tick"), producer.publish("tick")
    before_ns = time.monotonic_ns()
    publish_until_received(publication, SAMPLES[Tick], received.envelopes)
    envelope = received.envelopes[0]
    assert envelope.topic == "tick"
    assert_equal(envelope.message, SAMPLES[Tick])
    assert envelope.size_bytes == len(encode(SAMPLES[Tick]))
    header = envelope.header
    assert (header.producer, header.instance, header.epoch) == ("clock", producer.producer.instance, 7)
    assert header.stamp_ns == SAMPLES[Tick].stamp_ns
    assert header.clock_id == local_clock_id()
    assert before_ns <= header.publish_ns <= time.monotonic_ns()
    sequences = received.sequences()
    assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))
    assert publication.sent >= len(sequences)
    assert publication.bytes == publication.sent * envelope.size_bytes


def test_two_publications_count_apart_and_carry_the_epoch_of_their_process(make_bus):
    bus = make_bus("replay", epoch=1)
    tick, rig = bus.publish("tick"), bus.publish("rig")
    assert [tick.put(SAMPLES[Tick]).sequence for _ in range(3)] == [0, 1, 2]
    assert rig.put(SAMPLES[topic("rig").message]).sequence == 0
    bus.producer.epoch = 2  # as after a hand-over
    assert tick.put(SAMPLES[Tick]).epoch == 2


def _header(size=None):
    data = Header(1, 0, 0, 0, 1, "clock", "ab" * 8).pack()
    return data[:size]


@pytest.mark.parametrize(
    ("payload", "encoding", "attachment", "reason"),
    [
        (encode(SAMPLES[Tick]), "tick", None, "without a header"),
        (encode(SAMPLES[Tick]), "tick", _header(5), "too short"),
        (b"\x00garbage", "tick", _header(), "payload of 8"),
        (encode(SAMPLES[Tick]), "wheel/odometry", _header(), "WheelOdometry"),
        (bytes(17_000), "tick", _header(), "the limit is 0.016 MB"),
    ],
    ids=["no header", "short header", "garbage", "another message", "too large"],
)
def test_an_undecodable_message_is_reported_and_the_next_one_received(
    make_bus, robot, payload, encoding, attachment, reason
):
    producer, consumer = make_bus("clock"), make_bus("monitor")
    received, publication = Received(consumer, "tick"), producer.publish("tick")
    publish_until_received(publication, SAMPLES[Tick], received.envelopes, times=1)
    schema = encoding_of(encoding)
    producer.session.put(key(robot, "tick"), payload, encoding=schema, attachment=attachment)
    wait_until(lambda: received.undecodable)
    ((topic_name, text),) = received.undecodable
    assert topic_name == "tick"
    assert reason in text
    count = len(received.envelopes)
    publish_until_received(publication, SAMPLES[Tick], received.envelopes, times=count + 1)
    assert len(received.undecodable) == 1


def encoding_of(topic_name):
    return ENCODING.with_schema(schema_of(topic(topic_name).message))


def test_an_end_reaches_subscribers_of_before_and_after(make_bus):
    producer, early = make_bus("clock", epoch=3), make_bus("monitor")
    received = Received(early, "tick")
    publication = producer.publish("tick")
    publish_until_received(publication, SAMPLES[Tick], received.envelopes, times=2)
    producer.end(publication)
    expected = ("tick", producer.producer.instance, 3, publication.sent)
    wait_until(lambda: received.ends)
    late = Received(make_bus("recorder"), "tick")
    wait_until(lambda: late.ends)
    assert received.ends == [expected]
    assert late.ends == [expected]


def test_an_end_marker_that_is_none_is_reported(make_bus, robot):
    producer, consumer = make_bus("clock"), make_bus("monitor")
    received = Received(consumer, "tick")
    publication = producer.publish("tick")
    publish_until_received(publication, SAMPLES[Tick], received.envelopes, times=1)
    wait_until(lambda: producer.session.put(key(robot, "end", "tick"), b"\xc1") or received.undecodable)
    assert received.ends == []
    topic_name, text = received.undecodable[0]
    assert topic_name == "tick"
    assert text.startswith("end marker")


def test_a_node_is_alive_from_its_announcement_to_the_end_of_its_session(make_bus):
    node, watcher = make_bus("depth"), make_bus("replay")
    node.answer_queries(lambda name, query: None)
    assert watcher.alive_nodes() == set()
    node.announce(())
    wait_until(lambda: watcher.alive_nodes() == {"depth"})
    node.session.close()
    wait_until(lambda: watcher.alive_nodes() == set())


def test_a_process_answers_control_requests_at_once_and_queries_once_announced(make_bus, robot):
    node, client = make_bus("depth"), make_bus("page")
    asked = []

    def answer(name, query):
        with query:
            asked.append((name, dict(query.parameters)))
            query.reply(query.key_expr, b"yes")

    def ask(*parts):
        return [r.ok.payload.to_bytes() for r in client.session.get(key(robot, *parts), timeout=2.0) if r.ok]

    node.answer_queries(answer)
    instance = node.producer.instance
    wait_until(lambda: ask("control", "depth", control_id(instance), "reached") == [b"yes"])
    assert ask("query", "depth", "params") == []
    node.announce(("params",))
    wait_until(lambda: ask("query", "depth", "params?a=1") == [b"yes"])
    assert ask("query", "depth", "other") == []
    assert asked[0] == ("control/reached", {})
    assert asked[-1] == ("params", {"a": "1"})


def test_health_of_every_node_arrives_and_an_undecodable_one_is_reported(make_bus, robot):
    one, two, watcher = make_bus("depth"), make_bus("fusion"), make_bus("page")
    received, faults = [], []
    watcher.watch_health(lambda h: received.append((h.node, h.state)), lambda *fault: faults.append(fault))
    for bus, node in ((one, "depth"), (two, "fusion")):
        health = SAMPLES[Health].model_copy(update={"node": node, "state": "active"})
        wait_until(
            lambda bus=bus, health=health: bus.publish_health(health) or (health.node, "active") in received
        )
        bus.session.put(key(robot, "health", node), b"garbage", attachment=_header())
    count = len(received)
    wait_until(lambda: one.publish_health(SAMPLES[Health]) or len(received) > count)
    assert set(received) <= {("depth", "active"), ("fusion", "active")}
    assert {topic_name for topic_name, _ in faults} == {"health"}
    assert f"beamsplat/{robot}/health/depth: " in faults[0][1]


def test_a_source_waits_until_its_topics_have_subscribers(make_bus):
    producer, consumer = make_bus("clock"), make_bus("monitor")
    started = time.monotonic()
    producer.wait_for_subscribers(("tick",), 0.3)
    assert time.monotonic() - started >= 0.3  # nobody subscribes
    received = Received(consumer, "tick")
    producer.wait_for_subscribers(("tick",), 10.0)
    producer.publish("tick").put(SAMPLES[Tick])
    wait_until(lambda: received.sequences() == [0])
