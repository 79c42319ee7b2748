"""The hand-over requests of a supervisor to one process, with a bus that only records."""

import json

import numpy as np
import pytest

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError
from beamsplat.common.messages import Keyframe, KeyframeAck, MapStatus, Odometry, Scan
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.control import HandoverControl
from beamsplat.common.runtime.jobs import JobQueue, LazyFuture
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.mailbox import Envelope
from beamsplat.common.runtime.node import Job, Node
from beamsplat.common.runtime.running_node import RunningNode
from beamsplat.common.zenoh.streams import Producer
from tests.common.samples import sample_messages

SAMPLES = {type(m): m for m in sample_messages()}


class Localizer(Node):
    """Publishes a pose per scan; its state comes from its inputs."""

    name = "localization"
    inputs = ("lidar/scan",)
    outputs = ("localization/odometry",)
    replaceable = True

    def on_lidar_scan(self, scan):
        yield (
            "localization/odometry",
            Odometry(stamp_ns=scan.stamp_ns, T_odom_body=np.eye(4), covariance=np.eye(3)),
        )

    def on_query_params(self, parameters):
        return iter(())


class Mapper(Node):
    """Acknowledges keyframes on arrival; hands over its state."""

    name = "mapping"
    inputs = ("keyframes/frame",)
    outputs = ("keyframes/ack", "mapping/status")
    replaceable = hands_over = True

    def __init__(self, disk, disk_full=False):
        super().__init__(NodeConfig())
        self.disk, self.disk_full, self.steps = disk, disk_full, 0

    def on_keyframes_frame(self, frame):
        self.steps += 1
        yield Job("refine", lambda: frame.stamp_ns)

    def on_job_refine(self, stamp_ns):
        yield "mapping/status", SAMPLES[MapStatus].model_copy(update={"stamp_ns": stamp_ns})

    def on_arrival(self, topic, frame):
        yield "keyframes/ack", KeyframeAck(stamp_ns=frame.stamp_ns, id=frame.stamp_ns)

    def hand_over(self):
        if self.disk_full:
            raise UserError("the disk is full")
        self.disk.append(self.steps)

    def take_over(self):
        self.steps = self.disk[-1]


class RecordingBus:
    """The part of a bus that `HandoverControl` uses."""

    def __init__(self):
        self.producer = Producer("node", "ab" * 8, 0, 0)
        self.announced = []

    def announce(self, queries):
        self.announced.append(queries)


class RecordingPublication:
    def __init__(self, topic, log):
        self.topic, self.log = topic, log

    def put(self, message, backlog=0):
        self.log.append((self.topic, message.stamp_ns))


class Process:
    """A node process without threads and without Zenoh."""

    def __init__(self, node, run_dir, standby):
        self.node = node
        self.running = RunningNode(node, LiveSettings("r1", (), run_dir, standby=standby))
        self.running.jobs = JobQueue(LazyFutureWithCallback)
        self.bus, self.published = RecordingBus(), []
        self.running.publications = {
            topic: RecordingPublication(topic, self.published) for topic in node.outputs
        }
        self.control = HandoverControl(self.running, self.bus)

    def request(self, verb, **parameters):
        (answer,) = self.control.answer(verb, parameters)
        return answer.text

    def receive(self, topic, message_type, stamps, instance="cd" * 8):
        for stamp in stamps:
            message = SAMPLES[message_type].model_copy(update={"stamp_ns": stamp})
            self.running.receive(Envelope(topic, Header(stamp, 0, 0, stamp, 1, "x", instance), message))

    def step(self, count):
        """Handle `count` queued messages, as the runner does."""
        for _ in range(count):
            envelope = self.running.mailbox.pop()
            if not self.running.handover.was_handled(envelope):
                self.running.emit(self.node.handle(envelope.topic, envelope.message))


class LazyFutureWithCallback(LazyFuture):
    def add_done_callback(self, call):
        """A lazy future is finished when its result is requested: nobody has to be woken."""


def test_a_stateless_node_hands_over_between_two_messages(tmp_path):
    old = Process(Localizer(NodeConfig()), tmp_path, standby=False)
    new = Process(Localizer(NodeConfig()), tmp_path, standby=True)
    for process in (old, new):
        process.receive("lidar/scan", Scan, range(6))
    old.step(3)
    new.step(5)
    assert json.loads(old.request("reached")) == {"localization/odometry": 2}
    assert json.loads(new.request("reached")) == {"localization/odometry": 4}
    assert new.published == []
    after = old.request("retire")
    assert json.loads(new.request("activate", after=after)) == {"kept": 2, "lost": 0}
    old.step(1)
    new.step(1)
    stamps = [stamp for _, stamp in old.published + new.published]
    assert stamps == list(range(6))


def test_an_activated_process_answers_queries(tmp_path):
    new = Process(Localizer(NodeConfig()), tmp_path, standby=True)
    assert new.bus.announced == []
    new.request("activate", after='{"said": {}}')
    assert new.bus.announced == [("params",)]
    assert new.running.state == "active"


@pytest.mark.parametrize(("verb", "standby"), [("activate", False), ("dance", False), ("dance", True)])
def test_an_impossible_request_fails_and_changes_nothing(tmp_path, verb, standby):
    process = Process(Localizer(NodeConfig()), tmp_path, standby=standby)
    with pytest.raises(ValueError, match=f"localization cannot answer the request '{verb}'"):
        process.request(verb, after='{"said": {}}')
    assert process.running.handover.standby == standby
    assert not process.running.handover.retired
    assert process.bus.announced == []


def test_a_failed_activation_leaves_the_successor_in_standby(tmp_path):
    process = Process(Localizer(NodeConfig()), tmp_path, standby=True)
    with pytest.raises(ValueError, match="not the answer of a retired process"):
        process.request("activate", after="[]")
    assert process.running.handover.standby
    assert process.bus.announced == []


def test_a_node_with_state_finishes_its_jobs_and_passes_its_state_on(tmp_path):
    disk = []
    old, new = Process(Mapper(disk), tmp_path, standby=False), Process(Mapper(disk), tmp_path, standby=True)
    for process in (old, new):
        process.receive("keyframes/frame", Keyframe, range(4))
    old.step(2)
    after = old.request("retire")
    assert [entry for entry in old.published if entry[0] == "mapping/status"] == [
        ("mapping/status", 0),
        ("mapping/status", 1),
    ]
    assert disk == [2]
    assert "handled" in json.loads(after)
    new.request("activate", after=after)
    new.step(4)
    assert new.node.steps == 4  # two of the predecessor, and the two that it had not handled


def test_messages_that_arrived_in_standby_are_seen_on_activation_unless_they_were_handled(tmp_path):
    disk = []
    old, new = Process(Mapper(disk), tmp_path, standby=False), Process(Mapper(disk), tmp_path, standby=True)
    for process in (old, new):
        process.receive("keyframes/frame", Keyframe, range(4))
    old.step(3)
    assert new.published == []
    new.request("activate", after=old.request("retire"))
    assert new.published == [("keyframes/ack", 3)]
    new.receive("keyframes/frame", Keyframe, [4])
    assert new.published == [("keyframes/ack", 3), ("keyframes/ack", 4)]


def test_a_retired_process_does_not_answer_what_arrives_later(tmp_path):
    old = Process(Mapper([]), tmp_path, standby=False)
    old.request("retire")
    old.receive("keyframes/frame", Keyframe, [0])
    assert old.published == []


def test_a_node_that_cannot_write_its_state_stays_active(tmp_path):
    old = Process(Mapper([], disk_full=True), tmp_path, standby=False)
    with pytest.raises(UserError, match="the disk is full"):
        old.request("retire")
    assert not old.running.handover.retired
    old.receive("keyframes/frame", Keyframe, [5])
    assert old.published == [("keyframes/ack", 5)]
