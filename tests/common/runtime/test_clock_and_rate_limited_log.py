"""Stamps that no change of the host's time moves, and complaints at a bounded rate."""

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamsplat.common.runtime import rate_limited_log as complaints
from beamsplat.common.runtime.clock import StampClock
from beamsplat.common.runtime.rate_limited_log import RateLimitedLog


class Host:
    """A machine whose monotonic clock runs on while somebody sets its time of day."""

    def __init__(self):
        self.monotonic_ns, self.set_ns = 10**9, 1_800_000_000 * 10**9

    def clock(self, folder):
        return StampClock(folder, lambda: self.monotonic_ns, lambda: self.monotonic_ns + self.set_ns)


@given(steps=st.lists(st.tuples(st.integers(0, 10**10), st.integers(-(10**14), 10**14)), max_size=20))
def test_stamps_run_on_with_the_monotonic_clock_whatever_is_set(tmp_path_factory, steps):
    host = Host()
    clock = host.clock(tmp_path_factory.mktemp("clock"))
    first_ns, start_ns = clock.now_ns(), host.monotonic_ns
    for passed_ns, turned_ns in steps:
        host.monotonic_ns += passed_ns
        host.set_ns += turned_ns
        assert clock.now_ns() - first_ns == host.monotonic_ns - start_ns


def test_processes_started_later_agree_though_the_time_was_set(tmp_path):
    host = Host()
    first = host.clock(tmp_path)
    host.set_ns += 3600 * 10**9
    host.monotonic_ns += 5
    second = host.clock(tmp_path)
    assert second.now_ns() == first.now_ns()


def test_a_place_that_was_damaged_gives_a_clock_all_the_same(tmp_path):
    host = Host()
    host.clock(tmp_path)
    (place,) = tmp_path.iterdir()
    place.write_text("not a number")
    assert host.clock(tmp_path).now_ns() == host.monotonic_ns + host.set_ns
    assert [file.name for file in tmp_path.iterdir()] == [place.name]
    assert str(os.getuid()) in place.name


def test_what_repeats_is_counted_and_said_once_in_a_while(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(complaints.time, "monotonic", lambda: now[0])
    c = RateLimitedLog()
    assert c.due("loss") == 0
    assert [c.due("loss") for _ in range(7)] == [None] * 7
    assert c.due("other") == 0  # each subject by itself
    now[0] += complaints._PERIOD_S
    assert c.due("loss") == 7
    assert c.due("loss") is None
    now[0] += 2 * complaints._PERIOD_S
    assert c.due("loss") == pytest.approx(1)
