"""The stamp clock does not follow changes of the wall clock, and is common to all processes."""

import os
import tempfile
import time

from hypothesis import given
from hypothesis import strategies as st

from beamsplat.common.runtime.clock import StampClock


class Host:
    """A host with a simulated monotonic clock and a wall clock that can be set."""

    def __init__(self):
        self.monotonic_ns, self.set_ns = 10**9, 1_800_000_000 * 10**9

    def clock(self, folder):
        return StampClock(folder, lambda: self.monotonic_ns, lambda: self.monotonic_ns + self.set_ns)


@given(steps=st.lists(st.tuples(st.integers(0, 10**10), st.integers(-(10**14), 10**14)), max_size=20))
def test_stamps_follow_the_monotonic_clock_when_the_wall_clock_is_set(tmp_path_factory, steps):
    host = Host()
    clock = host.clock(tmp_path_factory.mktemp("clock"))
    first_ns, start_ns = clock.now_ns(), host.monotonic_ns
    for passed_ns, turned_ns in steps:
        host.monotonic_ns += passed_ns
        host.set_ns += turned_ns
        assert clock.now_ns() - first_ns == host.monotonic_ns - start_ns


def test_processes_started_after_a_change_of_the_wall_clock_use_the_same_offset(tmp_path):
    host = Host()
    first = host.clock(tmp_path)
    host.set_ns += 3600 * 10**9
    host.monotonic_ns += 5
    second = host.clock(tmp_path)
    assert second.now_ns() == first.now_ns()


def test_a_damaged_offset_file_is_ignored(tmp_path):
    host = Host()
    host.clock(tmp_path)
    (place,) = tmp_path.iterdir()
    place.write_text("not a number")
    assert host.clock(tmp_path).now_ns() == host.monotonic_ns + host.set_ns
    assert [file.name for file in tmp_path.iterdir()] == [place.name]
    assert str(os.getuid()) in place.name


def test_a_clock_works_where_no_temporary_folder_can_be_written(monkeypatch):
    def no_folder():
        raise FileNotFoundError("No usable temporary directory found")  # all disks are full or read-only

    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    monkeypatch.setattr(tempfile, "gettempdir", no_folder)
    assert abs(StampClock().now_ns() - time.time_ns()) < 60 * 10**9
