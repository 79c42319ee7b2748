"""Sinks that stall, fill up, disappear or cannot be opened: the node continues and reports it."""

import os
import subprocess
import sys
import textwrap
import threading
import time

import pytest
import rerun as rr

from beamsplat.services.monitor import rerun_writer
from beamsplat.services.monitor.layout import layout
from beamsplat.services.monitor.rerun_writer import (
    _QUEUE,
    _QUEUE_BYTES,
    RerunSinkThread,
    RerunWriter,
    _LogEntry,
)
from tests.common.polling import wait_until


class StuckStream:
    """A recording stream whose sink blocks until the test opens the gate."""

    def __init__(self):
        self.gate = threading.Event()
        self.logged = []

    def set_sinks(self, *sinks, default_blueprint):
        pass

    def reset_time(self):
        pass

    def set_time(self, *args, **kwargs):
        pass

    def flush(self, timeout_sec):
        if not self.gate.is_set():
            raise RuntimeError("Flush timed out - not all log messages were sent")

    def disconnect(self):
        pass

    def log(self, path, *parts, static):
        self.gate.wait()
        self.logged.append((path, *parts))


def test_a_stalled_viewer_blocks_nothing_and_gets_the_newest_entries():
    stream = StuckStream()
    thread = RerunSinkThread("viewer", stream, None, None)
    thread.put(_LogEntry("rig", ("rig",), None, True))
    for i in range(10 * _QUEUE):
        thread.put(_LogEntry(f"entity{i % 3}", (i,), i, False))
    assert not thread.flush(0.05)
    assert len(thread._queue) <= _QUEUE + 4
    assert thread.dropped >= 8 * _QUEUE
    stream.gate.set()
    assert thread.flush(10.0)
    thread.close(10.0)
    assert not thread.fault
    assert ("rig", "rig") in stream.logged
    newest = dict(stream.logged)
    assert {newest[f"entity{i}"] for i in range(3)} == {10 * _QUEUE - i for i in (1, 2, 3)}


def test_queued_entries_are_bounded_by_bytes():
    stream = StuckStream()
    thread = RerunSinkThread("viewer", stream, None, None)
    for i in range(200):
        thread.put(_LogEntry(f"splats{i % 4}", (i,), i, False, bytes=10_000_000))
    assert len(thread._queue) <= _QUEUE_BYTES // 10_000_000 + 4
    stream.gate.set()
    assert thread.flush(10.0)
    thread.close(10.0)
    newest = dict(stream.logged)
    assert {newest[f"splats{i}"] for i in range(4)} == {196, 197, 198, 199}
    assert thread._bytes == 0


def test_closing_has_a_timeout(caplog):
    stream = StuckStream()
    thread = RerunSinkThread("viewer", stream, None, None)
    thread.put(_LogEntry("a", (1,), None, False))
    thread.close(0.1)
    assert "viewer was not closed within 0.1 s" in caplog.text
    assert stream.logged == []
    stream.gate.set()
    thread.close(10.0)
    assert not thread._thread.is_alive()
    assert stream.logged == [("a", 1)]


def _draw_until_fault(writer, path="a"):
    deadline = time.monotonic() + 20.0
    while not writer.sinks[0].fault and time.monotonic() < deadline:
        writer.log(path, rr.TextDocument("x" * 100_000), stamp_ns=1)
        time.sleep(0.02)
    return writer.status


def test_a_file_is_closed_at_its_size_limit(tmp_path, read_rrd):
    writer = RerunWriter()
    path = writer.save(tmp_path / "sub" / "drive.rrd", layout(), limit_mb=0, keep_free_mb=0)
    assert "closed at" in _draw_until_fault(writer)
    writer.log("b", rr.TextDocument("more"))
    writer.close()
    assert read_rrd(path).entities == {"a"}


def test_a_file_is_closed_when_the_disk_is_nearly_full(tmp_path, read_rrd):
    writer = RerunWriter()
    path = writer.save(tmp_path / "drive.rrd", layout(), limit_mb=100, keep_free_mb=10**9)
    assert "left on the disk" in _draw_until_fault(writer)
    writer.close()
    assert read_rrd(path).entities == {"a"}


def test_a_removed_file_is_reported(tmp_path):
    writer = RerunWriter()
    path = writer.save(tmp_path / "drive.rrd", layout(), limit_mb=100, keep_free_mb=0)
    path.unlink()
    assert "the file was removed" in _draw_until_fault(writer)
    writer.close()


def test_a_write_error_is_reported(tmp_path):
    """The kernel refuses to write beyond a file size, as a full disk would."""
    script = """
        import os, resource, sys, time
        from pathlib import Path
        import rerun as rr
        from beamsplat.services.monitor.layout import layout
        from beamsplat.services.monitor.rerun_writer import RerunWriter
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
        writer = RerunWriter()
        writer.save(Path(sys.argv[1]), layout(), limit_mb=100, keep_free_mb=0)
        deadline = time.monotonic() + 30
        while not writer.sinks[0].fault and time.monotonic() < deadline:
            writer.log("a", rr.TextDocument(os.urandom(50_000).hex()), stamp_ns=1)
            time.sleep(0.01)
        writer.close()
        print(writer.status)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), str(tmp_path / "drive.rrd")],
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert "stopped:" in done.stdout, done
    assert "drive.rrd: " in done.stdout


def test_a_long_recording_has_parts_that_can_be_opened_alone(tmp_path, read_rrd, monkeypatch):
    monkeypatch.setattr(rerun_writer, "_PART_ENTRIES", 20)
    monkeypatch.setattr(rerun_writer, "_CHECK_S", 0.02)
    writer = RerunWriter()
    path = writer.save(tmp_path / "drive.rrd", layout(), limit_mb=100, keep_free_mb=0)
    writer.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    values = list(range(300))
    threads = 0
    for value in values:
        if value == 100:
            threads = len(os.listdir("/proc/self/task"))
        writer.log("curve", rr.Scalars(float(value)), stamp_ns=value)
        time.sleep(0.002)
    wait_until(
        lambda: len(os.listdir("/proc/self/task")) <= threads
    )  # a part that is closed may need a moment
    writer.close()
    assert not writer.sinks[0].fault
    count = len(list(tmp_path.glob("drive*.rrd")))
    assert count >= 4
    parts = [path, *(tmp_path / f"drive.part{n}.rrd" for n in range(2, count + 1))]
    seen = []
    for part in parts:
        saved = read_rrd(part)
        assert saved.entities >= {"map", "curve"}
        seen += [float(v[0]) for v in saved.column("curve", "Scalars:scalars")]
    assert seen == values


def test_a_file_is_never_overwritten(tmp_path):
    (tmp_path / "drive.rrd").write_bytes(b"precious")
    writer = RerunWriter()
    assert writer.save(tmp_path / "drive.rrd", layout(), limit_mb=1, keep_free_mb=0).name == "drive-2.rrd"
    writer.close()
    assert (tmp_path / "drive.rrd").read_bytes() == b"precious"


def test_a_folder_that_cannot_be_created_is_reported(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RuntimeError, match="cannot create the folder"):
        RerunWriter().save(tmp_path / "file" / "drive.rrd", layout(), limit_mb=1, keep_free_mb=0)
