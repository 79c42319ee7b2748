"""Garbage on every topic of a running node, with real sessions: counted, and nothing ends."""

import threading

import msgpack
import pytest
import zenoh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.messages.codec import encode, schema_of
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.live import Live
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.node import Input, Node
from beamsplat.common.topics import TOPICS
from beamsplat.common.zenoh.bridge import Bridge, BridgeSessions
from beamsplat.common.zenoh.bus import key, open_session
from beamsplat.common.zenoh.streams import ENCODING
from tests.common.polling import wait_until
from tests.common.samples import sample_messages

SAMPLES = {type(m): m for m in sample_messages()}
VALID = {name: encode(SAMPLES[row.message]) for name, row in TOPICS.items()}


def _everything(name):
    """Return a node class that subscribes to all topics and to the health of all nodes, and does nothing."""
    handlers = {row.handler: lambda self, message: iter(()) for row in TOPICS.values()}
    members = {"name": name, "inputs": tuple(Input(topic) for topic in TOPICS), **handlers}
    return type("Everything", (Node,), {**members, "on_health": lambda self, health: None})


class Target:
    """The node as a live process, in a thread; `faults` are the exceptions that have ended a thread."""

    def __init__(self, endpoint, robot, folder, monkeypatch):
        self.faults = []
        monkeypatch.setattr(threading, "excepthook", lambda fault: self.faults.append(fault))
        self.robot = robot
        self.live = Live(_everything("recorder")(NodeConfig()), LiveSettings(robot, (endpoint,), folder))
        self._thread = threading.Thread(target=self.live.run)
        self._thread.start()
        wait_until(lambda: self.live.running.state == "active")
        self.hostile = open_session((endpoint,))
        other = open_session((endpoint,))  # of a second robot with the same keys: the edge's side of a bridge
        self._bridge_sessions = (open_session((endpoint,)), other, open_session((endpoint,)))
        robot_side, edge, bulk = self._bridge_sessions
        self.bridge = Bridge(robot, BridgeSessions(robot=robot_side, edge=edge, edge_bulk=bulk))

    def counted(self):
        running = self.live.running
        with running.changed:
            inputs = running.mailbox.health()
        numbers = (i.received + i.dropped + i.undecodable + i.stale + i.refused for i in inputs)
        return sum(numbers) + running.undecodable_reports + running.reporters.total_refused

    def close(self):
        self.live.stop()
        self._thread.join(10.0)
        for session in (self.hostile, *self._bridge_sessions):
            session.close()


@pytest.fixture
def target(router_endpoint, robot, tmp_path, monkeypatch):
    made = Target(router_endpoint, robot, tmp_path, monkeypatch)
    yield made
    made.close()


def mutated(data):
    """Bytes of a valid message or header, some of them changed, perhaps cut off."""
    changes = st.lists(st.tuples(st.integers(0, max(len(data) - 1, 0)), st.integers(0, 255)), max_size=6)

    def change(drawn):
        positions, end = drawn
        changed = bytearray(data)
        for position, value in positions:
            changed[position] = value
        return bytes(changed[: len(changed) - end])

    return st.tuples(changes, st.sampled_from([0, 0, 0, 1, 7])).map(change)


uint64 = st.integers(0, 2**64 - 1)
int64 = st.integers(-(2**63), 2**63 - 1)
headers = st.builds(
    Header, int64, int64, uint64, st.one_of(st.integers(0, 300), uint64), st.integers(0, 2**32 - 1),
    st.text(max_size=20).filter(lambda t: len(t.encode("utf-8", "replace")) < 200 and t.isprintable()),
    st.sampled_from(["ab" * 8, "00" * 8, "ff" * 8]),
).map(Header.pack)  # fmt: skip
attachments = st.one_of(
    st.none(), headers, headers, st.binary(max_size=80),
    mutated(Header(1, 2, 3, 4, 5, "clock", "ab" * 8).pack()),
)  # fmt: skip
ends = st.one_of(
    st.integers(-5, 2**63).map(msgpack.packb), st.binary(max_size=20),
    st.sampled_from([b"\xdd\xff\xff\xff\xff", b"\x91" * 5000, msgpack.packb(True), msgpack.packb(1.5), b""]),
)  # fmt: skip
encodings = st.one_of(
    st.none(), st.text(max_size=30), st.sampled_from(["Scan/1", "Scan/1.99", "/", "Scan/9.9"])
)


@st.composite
def garbage(draw):
    """Return (key below the robot, payload, attachment, encoding)."""
    name = draw(st.sampled_from(sorted(TOPICS)))
    kind = draw(st.sampled_from(["topic", "topic", "topic", "end", "health"]))
    if kind == "end":
        return f"end/{name}", draw(ends), draw(attachments), None
    valid = VALID[name] if kind == "topic" else encode(SAMPLES[_health()])
    payload = draw(st.one_of(st.just(valid), mutated(valid), st.binary(max_size=300)))
    row = TOPICS[name].message if kind == "topic" else _health()
    encoding = draw(st.one_of(st.just(ENCODING.with_schema(schema_of(row))), encodings))
    path = name if kind == "topic" else f"health/{draw(st.sampled_from(['depth', 'x', 'localization']))}"
    return path, payload, draw(attachments), encoding


def _health():
    (health,) = [cls for cls in SAMPLES if cls.__name__ == "Health"]
    return health


@settings(
    max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)  # fmt: skip
@given(samples=st.lists(garbage(), min_size=10, max_size=40))
def test_garbage_on_every_topic_is_counted_and_ends_nothing(target, samples):
    before = target.counted()
    for path, payload, attachment, encoding in samples:
        encoding = zenoh.Encoding(encoding) if isinstance(encoding, str) else encoding
        target.hostile.put(key(target.robot, path), payload, encoding=encoding, attachment=attachment)
    expected = any(not path.startswith("end/") for path, *_ in samples)
    wait_until(lambda: target.counted() > before or not expected)
    assert target.faults == []
    assert target.live.running.state == "active"


def test_after_garbage_every_receiving_thread_still_receives(target):
    for name, row in TOPICS.items():
        undecodable = target.live.running.mailbox.counts[name]
        for payload in (b"", b"\xff" * 100, bytes(row.limit_kb * 1000 + 1)[: 10**6], VALID[name]):
            target.hostile.put(key(target.robot, name), payload, attachment=b"BS")
        wait_until(lambda u=undecodable: u.undecodable >= 1)
        count = target.live.running.mailbox.counts[name]
        header = Header(5, 0, 0, 0, 1, row.producers[0], "cd" * 8).pack()
        encoding = ENCODING.with_schema(schema_of(row.message))

        def send(name=name, header=header, encoding=encoding):
            target.hostile.put(key(target.robot, name), VALID[name], encoding=encoding, attachment=header)

        wait_until(lambda c=count, s=send: s() or c.producer.current is not None)
    assert target.faults == []
    assert sum(target.bridge.forwarded[name].messages for name in target.bridge.forwarded) > 0
