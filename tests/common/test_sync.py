"""Streams merge by stamp whatever the order of arrival."""

from hypothesis import given, settings
from hypothesis import strategies as st

from common.sync import PATIENCE_NS, StampMerger


def _drain(merger):
    out = []
    while (item := merger.pop()) is not None:
        out.append(item)
    return out


stamps = st.lists(st.integers(0, 400_000_000), unique=True, max_size=20).map(sorted)


@given(a=stamps, b=stamps, arrivals=st.randoms(use_true_random=False))
@settings(max_examples=200, deadline=None)
def test_any_interleaving_of_arrivals_gives_the_same_order(a, b, arrivals):
    """Both streams keep their own order; how they interleave on the way must not matter."""
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
    assert _drain(merger) == [("a", "a90")]  # b100 waits: an a95 could come
    merger.put("a", 110, "a110")
    assert _drain(merger) == [("b", "b100")]


def test_a_silent_stream_is_given_up_and_taken_back():
    merger = StampMerger(("a", "b"))
    merger.put("a", 0, "a0")
    merger.put("b", 0, "b0")
    assert len(_drain(merger)) == 2
    merger.put("b", PATIENCE_NS, "b1")
    assert merger.pop() is None
    merger.put("b", PATIENCE_NS + 1, "b2")
    assert _drain(merger) == [("b", "b1"), ("b", "b2")]  # a has been silent for too long
    merger.put("a", PATIENCE_NS - 5, "late")
    assert _drain(merger) == [("a", "late")]
    assert merger.late == 1
    merger.put("b", PATIENCE_NS + 3, "b3")
    assert merger.pop() is None  # a speaks again, and is waited for again


def test_a_stream_that_never_spoke_is_given_up_as_well():
    merger = StampMerger(("a", "b"))
    for i in range(8):
        merger.put("b", i * 100_000_000, i)
    assert [item for _, item in _drain(merger)] == list(range(8))


def test_equal_stamps_go_by_row():
    merger = StampMerger(("a", "b"))
    merger.put("b", 5, "b")
    merger.put("a", 5, "a")
    merger.put("a", 6, "a6")
    merger.put("b", 6, "b6")
    assert [item for _, item in _drain(merger)] == ["a", "b", "a6", "b6"]
