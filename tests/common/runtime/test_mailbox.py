"""The mailbox: end of stream, gaps in the sequence, limits of the queues."""

import numpy as np

from beamsplat.common.messages import Scan
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.mailbox import Envelope, Mailbox
from beamsplat.common.runtime.node import Input
from tests.common.nodes import Chain, Slow

FIRST, SECOND = "ab" * 8, "cd" * 8


def _scan(sequence, *, instance=FIRST, epoch=1, size_bytes=0):
    stamp_ns = sequence % 2**32
    scan = Scan(
        stamp_ns=stamp_ns, angle_min_rad=0.0, angle_increment_rad=0.1, time_increment_s=0.0, scan_time_s=0.1,
        range_min_m=0.0, range_max_m=1.0, ranges_m=np.zeros(1, np.float32),
    )  # fmt: skip
    header = Header(stamp_ns, 0, 0, sequence, epoch, "replay", instance)
    return Envelope("lidar/scan", header, scan, size_bytes)


def _ended_mailbox():
    mailbox = Mailbox(Chain)
    mailbox.put(_scan(0))
    mailbox.end("wheel/odometry", FIRST, 1)
    mailbox.end("lidar/scan", FIRST, 1)
    assert mailbox.pop() is not None
    assert mailbox.ended
    return mailbox


def test_a_message_after_the_end_of_its_stream_is_delivered_and_the_stream_stays_ended():
    """Recovery can deliver a message after the end-of-stream time-out: the stream must still end."""
    mailbox = _ended_mailbox()
    mailbox.put(_scan(1))
    assert not mailbox.ended
    assert mailbox.pop().header.sequence == 1
    assert mailbox.ended


def test_a_successor_reopens_an_ended_stream():
    mailbox = _ended_mailbox()
    mailbox.put(_scan(0, instance=SECOND, epoch=2))
    mailbox.end("lidar/scan", FIRST, 1)  # an end marker of the predecessor is ignored
    assert mailbox.pop() is not None
    assert not mailbox.ended


def test_a_count_beyond_int64_is_reported_as_the_largest_int64():
    mailbox = Mailbox(Chain)
    for sequence in (0, 2**64 - 1):
        mailbox.put(_scan(sequence))
    health = {entry.topic: entry for entry in mailbox.health()}
    assert health["lidar/scan"].lost == 2**63 - 1


class Small(Slow):
    """A node with a small queue."""

    name = "localization"
    inputs = (Input("lidar/scan", "every", queued_bytes=10_000),)


def test_a_queue_is_limited_in_bytes():
    mailbox = Mailbox(Small)
    for sequence in range(100):
        mailbox.put(_scan(sequence, size_bytes=1000))
    assert len(mailbox) == 10
    assert mailbox.counts["lidar/scan"].dropped == 90
    assert [mailbox.pop().header.sequence for _ in range(10)] == list(range(90, 100))
    mailbox.put(_scan(100, size_bytes=50_000))  # one that is larger than the bound still passes
    assert mailbox.pop().header.sequence == 100
    assert mailbox.counts["lidar/scan"].dropped == 90


def test_messages_missing_at_the_end_of_a_stream_are_lost():
    mailbox = Mailbox(Chain)
    mailbox.end("lidar/scan", "ab" * 8, 1, sent=3)
    assert mailbox.counts["lidar/scan"].lost == 3
