"""Merging by stamp does not depend on the order of arrival."""

from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.common.runtime.stamp_merger import TIMEOUT_NS, StampMerger


def _drain(merger):
    out = []
    while (item := merger.pop()) is not None:
        out.append(item)
    return out


stamps = st.lists(st.integers(0, 400_000_000), unique=True, max_size=20).map(sorted)


@given(a=stamps, b=stamps, arrivals=st.randoms(use_true_random=False))
@settings(max_examples=200, deadline=None)
def test_any_interleaving_of_arrivals_gives_the_same_order(a, b, arrivals):
    """Each stream keeps its own order; how their arrivals interleave must not matter."""
    queues = {"a": list(a), "b": list(b)}
    merger, out = StampMerger(("a", "b")), []
    while any(queues.values()):
        name = arrivals.choice([n for n, q in queues.items() if q])
        stamp = queues[name].pop(0)
        merger.put(name, stamp, (stamp, name))
        out += _drain(merger)
        if not queues[name]:
            merger.end(name)
    for name in ("a", "b"):
        merger.end(name)
    out += _drain(merger)
    assert [item for _, item in out] == sorted([(s, "a") for s in a] + [(s, "b") for s in b])
    assert merger.ended
    assert merger.late == 0


def test_nothing_is_released_before_it_is_certain():
    merger = StampMerger(("a", "b"))
    merger.put("b", 100, "b100")
    assert merger.pop() is None
    merger.put("a", 90, "a90")
    assert _drain(merger) == [("a", "a90")]  # b100 is held: a message a95 could still arrive
    merger.put("a", 110, "a110")
    assert _drain(merger) == [("b", "b100")]


def test_a_silent_stream_times_out_until_its_next_message():
    merger = StampMerger(("a", "b"))
    merger.put("a", 0, "a0")
    merger.put("b", 0, "b0")
    assert len(_drain(merger)) == 2
    merger.put("b", TIMEOUT_NS, "b1")
    assert merger.pop() is None
    merger.put("b", TIMEOUT_NS + 1, "b2")
    assert _drain(merger) == [("b", "b1"), ("b", "b2")]  # a has timed out
    merger.put("a", TIMEOUT_NS - 5, "late")
    assert _drain(merger) == [("a", "late")]
    assert merger.late == 1
    merger.put("b", TIMEOUT_NS + 3, "b3")
    assert merger.pop() is None  # a is waited for again


def test_a_stream_without_any_message_times_out():
    merger = StampMerger(("a", "b"))
    for i in range(8):
        merger.put("b", i * 100_000_000, i)
    assert [item for _, item in _drain(merger)] == list(range(8))


def test_equal_stamps_are_ordered_by_stream():
    merger = StampMerger(("a", "b"))
    merger.put("b", 5, "b")
    merger.put("a", 5, "a")
    merger.put("a", 6, "a6")
    merger.put("b", 6, "b6")
    assert [item for _, item in _drain(merger)] == ["a", "b", "a6", "b6"]


@given(a=stamps, b=stamps, arrivals=st.randoms(use_true_random=False))
@settings(max_examples=100, deadline=None)
def test_with_a_clock_delayed_messages_are_waited_for(a, b, arrivals):
    """With a clock, the order is that of the stamps, however far one stream is ahead in a burst."""
    queues = {"a": [10 * s for s in a], "b": [10 * s for s in b]}  # gaps far beyond the time-out
    expected = sorted((s, n) for n, queue in queues.items() for s in queue)
    merger, out = StampMerger(("a", "b"), clock_ns=lambda: 0), []
    while any(queues.values()):
        name = arrivals.choice([n for n, q in queues.items() if q])
        for _ in range(arrivals.randrange(1, 20)):
            if queues[name]:
                stamp = queues[name].pop(0)
                merger.put(name, stamp, (stamp, name))
                out += _drain(merger)
    for name in ("a", "b"):
        merger.end(name)
    out += _drain(merger)
    assert [item for _, item in out] == expected
    assert merger.late == 0


def test_with_a_clock_a_silent_stream_times_out():
    now_ns = 0
    merger = StampMerger(("a", "b"), clock_ns=lambda: now_ns)
    for i in range(8):
        merger.put("b", i * 100_000_000, i)
    assert merger.pop() is None
    now_ns = TIMEOUT_NS
    assert merger.pop() is None
    now_ns = TIMEOUT_NS + 1
    assert [item for _, item in _drain(merger)] == list(range(8))


def _both(merger, start_ns, count=10):
    """Return the merged order of two 10 Hz streams 1 ns apart, of which the newer arrives first."""
    out = []
    for i in range(count):
        for name, stamp_ns in (("b", start_ns + i * 100_000_000 + 1), ("a", start_ns + i * 100_000_000)):
            merger.put(name, stamp_ns, (stamp_ns, name))
            out += [item for _, item in _drain(merger)]
    return out


def test_streams_merge_in_order_after_their_clock_was_set_back():
    merger = StampMerger(("a", "b"))
    _both(merger, 1_000_000_000_000)
    after = _both(merger, 10_000_000_000)
    assert len(after) >= 19
    settled = after[4:]
    assert settled == sorted(settled)


def test_merging_continues_after_one_wrong_stamp():
    merger = StampMerger(("a", "b"))
    _both(merger, 0)
    merger.put("a", 2**62, (2**62, "a"))
    after = [item for item in _both(merger, 1_000_000_000) if item[0] < 2**62]
    assert len(after) >= 19
    settled = after[4:]
    assert settled == sorted(settled)
