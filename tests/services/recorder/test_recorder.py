from __future__ import annotations

import errno
import os

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Health, Tick
from beamsplat.common.messages.header import Header
from beamsplat.common.recording import RecordingReader
from beamsplat.common.topics import TOPICS
from beamsplat.services.recorder import node as recorder_node
from beamsplat.services.recorder.arrival import ArrivalClock
from beamsplat.services.recorder.config import RecorderConfig
from beamsplat.services.recorder.node import RecorderNode
from tests.common.files.small_disk import SmallDisk
from tests.common.messages.random_messages import assert_same, random_message

SECOND = 10**9


def started(tmp_path, **options):
    node = RecorderNode(RecorderConfig(out=tmp_path / "rec", sync=False, **options))
    node.configure()
    return node


def test_every_topic_and_its_header_is_kept(tmp_path):
    rng = np.random.default_rng(0)
    node = started(tmp_path, clock="data")
    sent = []
    for i, row in enumerate(TOPICS.values()):
        message = random_message(row.message, rng).model_copy(update={"stamp_ns": i * SECOND})
        header = Header(message.stamp_ns, 5, 7, i, 1, row.producers[0], "00112233445566ff")
        node.on_header(header)
        assert list(node.handle(row.name, message)) == []
        sent.append((row.name, message, header))
    node.close()
    with RecordingReader(tmp_path / "rec") as reader:
        recorded = list(reader.messages())
    assert len(recorded) == len(sent)
    for (topic, message, header), back in zip(sent, recorded):
        assert (back.topic, back.header, back.log_time_ns) == (topic, header, message.stamp_ns)
        assert_same(back.message, message)


def test_every_means_every(tmp_path):
    deliveries = {entry.topic: entry.effective_delivery for entry in RecorderNode.inputs}
    assert set(deliveries) == set(TOPICS)
    assert deliveries["camera/image"] == "every"
    assert deliveries["rig"] == "latched"


def test_topics_that_are_not_chosen_are_not_subscribed_to(tmp_path):
    node = RecorderNode(RecorderConfig(out=tmp_path / "rec", without=("fusion/depth", "camera/image")))
    assert node.ignored_inputs() == {"fusion/depth", "camera/image"}


def test_topics_are_chosen(tmp_path):
    node = started(tmp_path, topics=("tick", "rig"), without=("rig",), clock="data")
    rng = np.random.default_rng(0)
    for row in TOPICS.values():
        list(node.handle(row.name, random_message(row.message, rng)))
    node.close()
    with RecordingReader(tmp_path / "rec") as reader:
        assert set(reader.counts) == {"tick"}
    with pytest.raises(UserError, match="no topic called 'ticks'"):
        RecorderNode(RecorderConfig(out=tmp_path / "x", topics=("ticks",)))


def test_health_is_kept_once_the_clock_of_the_data_is_known(tmp_path):
    node = started(tmp_path, clock="data")
    health = Health(stamp_ns=4 * 10**18, node="depth", instance="a", epoch=0, state="active")
    node.on_health(health)
    list(node.handle("tick", Tick(stamp_ns=7 * SECOND, count=0)))
    node.on_health(health)
    node.close()
    with RecordingReader(tmp_path / "rec") as reader:
        assert [(r.topic, r.log_time_ns) for r in reader.messages()] == [
            ("tick", 7 * SECOND), ("health/depth", 7 * SECOND),
        ]  # fmt: skip


def test_a_restarted_recorder_writes_beside_its_predecessor(tmp_path):
    for _ in range(3):
        node = started(tmp_path)
        node.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rec", "rec_2", "rec_3"]


def test_a_full_disk_is_logged_once_and_the_node_lives(tmp_path, monkeypatch, caplog):
    node = started(tmp_path, clock="data", chunk_s=0.0)
    list(node.handle("tick", Tick(stamp_ns=SECOND, count=0)))

    def full(fd, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    for i in range(2, 6):
        list(node.handle("tick", Tick(stamp_ns=i * SECOND, count=i)))
    node.close()
    assert sum("the disk is full" in record.message for record in caplog.records) == 1
    assert node.lost.total() == 4
    with RecordingReader(tmp_path / "rec") as reader:
        assert len(list(reader.messages())) == 1


@pytest.mark.parametrize("full_at", ["the start", "a later message"])
def test_recording_begins_again_when_the_disk_has_room(tmp_path, full_at, monkeypatch):
    monkeypatch.setattr(recorder_node, "_RETRY_S", 0.0)
    disk = SmallDisk(tmp_path / "disk", 24)
    try:
        if full_at == "the start":
            disk.fill()
        node = started(disk.path, clock="data", chunk_s=0.0)
        if full_at == "a later message":
            list(node.handle("tick", Tick(stamp_ns=SECOND, count=0)))
            disk.fill()
        for i in range(2, 60):
            list(node.handle("tick", Tick(stamp_ns=i * SECOND, count=i)))
        lost = node.lost.total()
        assert lost > 0
        assert node.detail.startswith("NOT RECORDING")
        assert [(f.name, f.value) for f in node.figures.report()] == [("recording", 0.0)]
        disk.free()
        for i in range(60, 63):
            list(node.handle("tick", Tick(stamp_ns=i * SECOND, count=i)))
        node.close()
        assert node.lost.total() == lost
        (refused,) = node.rejections.report()
        assert (refused.reason, refused.count) == ("messages not recorded: the disk is full or broken", lost)
        counts = []
        for path in sorted(disk.path.iterdir()):
            with RecordingReader(path) as reader:
                counts.append(len(list(reader.messages())))
        assert counts[-1] == 3
        assert sum(counts) + lost == (61 if full_at == "the start" else 62)
    finally:
        disk.close()


def test_arrival_on_a_running_robot_is_the_time_of_publication():
    now = {"wall": 1_700_000_000 * SECOND, "monotonic": 50 * SECOND}
    clock = ArrivalClock("auto", lambda: now["wall"], lambda: now["monotonic"])
    assert clock.now_ns() is None
    stamp = now["wall"] - SECOND
    assert clock.arrival_ns(stamp, now["monotonic"] - SECOND // 4) == now["wall"] - SECOND // 4
    assert clock.arrival_ns(stamp, None) == now["wall"]
    assert clock.now_ns() == now["wall"]


def test_arrival_of_replayed_data_follows_its_stamps():
    clock = ArrivalClock("auto", lambda: 1_900_000_000 * SECOND, lambda: 0)
    stamps = [1_700_000_000 * SECOND + i for i in (0, 5, 3, 9)]
    assert [clock.arrival_ns(stamp, 0) - stamps[0] for stamp in stamps] == [0, 5, 5, 9]
    assert clock.now_ns() == stamps[-1]
