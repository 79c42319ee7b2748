"""The mailbox: end of stream, gaps in the sequence, limits of the queues."""

import pickle

import numpy as np
import pytest

from beamsplat.common.messages import Correction, Scan
from beamsplat.common.messages.header import Header
from beamsplat.common.messages.instances import ProcessId, process_of
from beamsplat.common.runtime.mailbox import Envelope, Mailbox
from beamsplat.common.runtime.node import Input
from beamsplat.common.runtime.sequence import MAX_JUMP
from tests.common.nodes import Chain, Slow

SEED = b"seed of the supervisor"
FIRST, SECOND, THIRD = (process_of(SEED, "replay", epoch) for epoch in (1, 2, 3))
STRANGER = ProcessId("replay", 7, "ef" * 8)  # has no proof
S = 1_000_000_000


class Clock:
    ns = 100 * S

    def __call__(self):
        return self.ns


def _scan(sequence, *, by=FIRST, size_bytes=0):
    stamp_ns = sequence % 2**32
    scan = Scan(
        stamp_ns=stamp_ns, angle_min_rad=0.0, angle_increment_rad=0.1, time_increment_s=0.0, scan_time_s=0.1,
        range_min_m=0.0, range_max_m=1.0, ranges_m=np.zeros(1, np.float32),
    )  # fmt: skip
    header = Header(stamp_ns, 0, 0, sequence, by.epoch, by.node, by.instance)
    return Envelope("lidar/scan", header, scan, size_bytes)


def _ended_mailbox():
    mailbox = Mailbox(Chain)
    mailbox.put(_scan(0))
    mailbox.end("wheel/odometry", FIRST, 0)
    mailbox.end("lidar/scan", FIRST, 2)
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
    mailbox.put(_scan(0, by=SECOND))
    assert not mailbox.end("lidar/scan", FIRST, 1)  # an end marker of the predecessor is ignored
    assert mailbox.pop() is not None
    assert not mailbox.ended


def test_a_count_beyond_int64_is_reported_as_the_largest_int64():
    mailbox = Mailbox(Chain)
    mailbox.end("lidar/scan", FIRST, 2**64 - 1)
    assert _health(mailbox).lost == 2**63 - 1


def _health(mailbox):
    (health,) = [entry for entry in mailbox.health() if entry.topic == "lidar/scan"]
    return health


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


class Keeping(Slow):
    """A node that handles every scan, unless it falls behind by more than three."""

    name = "localization"
    inputs = (Input("lidar/scan", "latest", keep=3),)


def test_a_ring_keeps_the_newest_messages_in_order_and_counts_the_others():
    mailbox = Mailbox(Keeping)
    for sequence in range(5):
        mailbox.put(_scan(sequence))
    assert len(mailbox) == 3
    assert mailbox.counts["lidar/scan"].dropped == 2
    assert [mailbox.pop().header.sequence for _ in range(3)] == [2, 3, 4]
    assert mailbox.pop() is None
    mailbox.put(_scan(5))
    assert mailbox.pop().header.sequence == 5
    assert mailbox.counts["lidar/scan"].dropped == 2


def test_messages_missing_at_the_end_of_a_stream_are_lost():
    mailbox = Mailbox(Chain)
    mailbox.end("lidar/scan", FIRST, 3)
    assert _health(mailbox).lost == 3


def _sequences(mailbox):
    mailbox.end("wheel/odometry", None)
    found = []
    while (envelope := mailbox.pop()) is not None:
        found.append(envelope.header.sequence)
    return found


def test_messages_that_are_recovered_are_delivered_in_order_and_counted_as_late_not_as_lost():
    clock = Clock()
    mailbox = Mailbox(Chain, clock)
    for sequence in (0, 4, 2, 1, 2):
        mailbox.put(_scan(sequence))
    health = _health(mailbox)
    assert (health.late, health.lost, health.stale) == (2, 0, 1)  # 2 came twice, 3 is still missing
    assert mailbox.handled()["lidar/scan"] == {FIRST.instance: (5, [0, 1, 2, 3, 4])}
    assert _sequences(mailbox) == [0, 1, 2, 4]
    assert mailbox.handled()["lidar/scan"] == {FIRST.instance: (5, [3])}
    clock.ns += 6 * S
    assert (_health(mailbox).late, _health(mailbox).lost) == (2, 1)
    assert not mailbox.put(_scan(3))  # given up


def test_a_gap_that_is_being_filled_is_not_lost():
    clock = Clock()
    mailbox = Mailbox(Chain, clock)
    mailbox.put(_scan(0))
    mailbox.put(_scan(21))
    for sequence in range(1, 21):
        clock.ns += S
        assert mailbox.put(_scan(sequence))
    assert (_health(mailbox).late, _health(mailbox).lost) == (20, 0)


def test_a_successor_with_proof_takes_over_at_once_and_its_predecessor_is_stale():
    mailbox = Mailbox(Chain, Clock())
    assert mailbox.put(_scan(5))
    assert mailbox.put(_scan(0, by=THIRD))  # the second one was never heard
    assert not mailbox.put(_scan(6))
    assert not mailbox.put(_scan(0, by=SECOND))
    assert (_health(mailbox).stale, _health(mailbox).refused) == (2, 0)


@pytest.mark.parametrize("epoch", [0, 1, 2, 7, 2**32 - 1])
def test_a_higher_epoch_without_proof_does_not_silence_a_stream(epoch):
    clock = Clock()
    mailbox = Mailbox(Chain, clock)
    stranger = STRANGER._replace(epoch=epoch)
    for sequence in range(100):
        clock.ns += S // 10
        assert mailbox.put(_scan(sequence))
        assert not mailbox.put(_scan(sequence, by=stranger))
        assert not mailbox.end("lidar/scan", stranger, 1)
    assert _health(mailbox).refused == 200
    assert mailbox.put(_scan(0, by=SECOND))


def test_a_process_without_proof_is_accepted_after_a_silence_and_gives_way_to_the_one_before():
    """The folder with the seed was deleted, or somebody else waits for a silence."""
    clock = Clock()
    mailbox = Mailbox(Chain, clock)
    assert mailbox.put(_scan(50, by=THIRD))
    clock.ns += 4 * S
    assert not mailbox.put(_scan(0, by=STRANGER._replace(epoch=1)))
    clock.ns += 2 * S
    assert mailbox.put(_scan(1, by=STRANGER._replace(epoch=1)))  # also of a lower epoch
    assert mailbox.put(_scan(2, by=STRANGER._replace(epoch=1)))
    assert mailbox.put(_scan(51, by=THIRD))
    assert not mailbox.put(_scan(3, by=STRANGER._replace(epoch=1)))


def test_an_end_marker_without_proof_ends_nothing_however_long_the_producer_is_silent():
    """A node whose inputs have all ended cannot go on, and a stalled producer does."""
    clock = Clock()
    mailbox = Mailbox(Chain, clock)
    assert mailbox.put(_scan(0))
    for name in ("lidar/scan", "wheel/odometry"):
        mailbox.end(name, None)
    assert mailbox.pop() is not None
    assert mailbox.put(_scan(1))  # goes on: nobody has ended it
    mailbox.pop()
    clock.ns += 60 * S
    assert not mailbox.end("lidar/scan", STRANGER, 0)
    assert not mailbox.ended
    assert _health(mailbox).refused == 1
    assert mailbox.put(_scan(2))
    mailbox.pop()
    assert mailbox.end("lidar/scan", FIRST, 3)
    assert mailbox.ended


def _correction(number, by):
    correction = Correction(stamp_ns=0, T_map_odom=np.eye(4))
    header = Header(0, 0, 0, number, by.epoch, by.node, by.instance)
    return Envelope("localization/correction", header, correction)


class Corrected(Slow):
    """A node with a latched input, which is published rarely, and one that is published all the time."""

    name = "localization"
    inputs = ("localization/correction", "lidar/scan")

    def on_localization_correction(self, message):
        return iter(())


def test_a_producer_that_is_heard_on_one_input_is_not_silent_on_another():
    clock = Clock()
    mailbox = Mailbox(Corrected, clock)
    mailbox.put(_correction(0, FIRST))
    for sequence in range(20):
        clock.ns += S
        mailbox.put(_scan(sequence))
    assert not mailbox.put(_correction(0, STRANGER))
    assert mailbox.put(_correction(1, FIRST))


def test_a_latched_message_without_proof_waits_for_the_silence():
    clock = Clock()
    mailbox = Mailbox(Corrected, clock)
    mailbox.put(_correction(3, FIRST))
    assert mailbox.pop().header.sequence == 3
    clock.ns += S
    assert not mailbox.put(_correction(0, STRANGER))  # published once, right after a restart
    assert mailbox.pop() is None
    clock.ns += 6 * S
    assert mailbox.pop().header.instance == STRANGER.instance


@pytest.mark.parametrize("sequence", [MAX_JUMP + 10, 2**63, 2**64 - 1])
def test_a_jump_of_the_sequence_does_not_silence_a_stream(sequence):
    clock = Clock()
    mailbox = Mailbox(Corrected, clock)
    mailbox.put(_scan(0))
    mailbox.put(_correction(0, FIRST))
    assert not mailbox.put(_scan(sequence))
    assert not mailbox.put(_correction(sequence, FIRST))
    assert mailbox.put(_scan(1))
    assert mailbox.put(_correction(1, FIRST))
    assert _health(mailbox).refused == 1


def test_jumps_within_the_limit_do_not_silence_a_stream_either():
    clock = Clock()
    mailbox = Mailbox(Chain, clock)
    for sequence in range(200):
        clock.ns += S // 10
        assert mailbox.put(_scan(sequence))
        for number in range(3):
            mailbox.put(_scan(1000 * (3 * sequence + number + 1)))


def test_a_false_end_does_not_end_a_stream_that_goes_on():
    mailbox = _ended_mailbox()
    mailbox.put(_scan(1))
    mailbox.put(_scan(2))  # the marker said that two messages were sent
    assert mailbox.pop() is not None
    assert mailbox.pop() is not None
    assert not mailbox.ended


def test_any_number_of_instances_leaves_a_mailbox_as_small_as_before():
    clock = Clock()
    mailbox = Mailbox(Chain, clock)
    for number in range(2000):
        clock.ns += 6 * S
        mailbox.put(_scan(0, by=ProcessId("replay", number % 7, f"{number:016x}")))
        mailbox.put(_scan(2, by=ProcessId("replay", number % 7, f"{number:016x}")))
        while mailbox.pop():
            pass
    assert len(pickle.dumps(mailbox.counts)) < 5000
    assert len(mailbox._heard_ns) < 10
