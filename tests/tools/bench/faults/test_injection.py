"""Disk and clock that fail in a process which knows nothing of it."""

import errno
import os
import subprocess
import sys
import time

import pytest

from beamsplat.tools.bench.faults.injection import environment, write_control

# What a program does with files; each line of standard input is a command, each answer one line.
PROGRAM = """
import os, sys, time, tempfile
from pathlib import Path
import numpy as np

folder = Path(sys.argv[1])
kept = (folder / "kept").open("ab", buffering=0)

def text(): (folder / "text").write_text("x" * 10_000)
def array():
    with (folder / "array.npz").open("wb") as file: np.savez(file, a=np.zeros(1000))
def append(): kept.write(b"x" * 1000)
def fsync():
    with open(folder / "synced", "wb") as file:
        file.write(b"x")
        file.flush()
        os.fsync(file.fileno())
def folder_sync():
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try: os.fsync(opened)
    finally: os.close(opened)
def replace(): (folder / "old").replace(folder / "new"); (folder / "new").replace(folder / "old")
def remove(): (folder / "removed").touch(); (folder / "removed").unlink()
def unlink(): (folder / "old").unlink()
def mkdir(): (folder / "made").mkdir(); (folder / "made").rmdir()
def descriptor():
    opened = os.open(folder / "descriptor", os.O_WRONLY | os.O_CREAT)
    try: os.write(opened, b"x")
    finally: os.close(opened)
def temporary():
    with tempfile.NamedTemporaryFile(dir=folder) as file: file.write(b"x" * 10_000); file.flush()
def elsewhere(): (folder.parent / "elsewhere").write_text("x")
def read(): assert (folder / "old").read_text() == "old"
def clock(): return time.time(), time.time_ns() / 1e9, time.monotonic()

for line in sys.stdin:
    try:
        answer = globals()[line.strip()]()
        print("ok" if answer is None else repr(answer), flush=True)
    except OSError as error:
        print(error.errno, flush=True)
"""
ALL = (
    "text",
    "array",
    "append",
    "fsync",
    "folder_sync",
    "replace",
    "remove",
    "mkdir",
    "descriptor",
    "temporary",
)
WRITES = ("text", "array", "append", "fsync", "descriptor", "temporary")


class Program:
    def __init__(self, tmp_path):
        self.folder, self.control = tmp_path / "disk", tmp_path / "control.json"
        self.folder.mkdir()
        (self.folder / "old").write_text("old")
        added = environment(tmp_path / "site", self.control)
        self._process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(self.folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            text=True, env={**os.environ, **added},
        )  # fmt: skip
        assert self.do("read") == "ok"  # it has started

    def fail(self, **faults):
        write_control(self.control, self.folder, **faults)

    def do(self, name):
        """Return "ok", the number of the error, or what the program answers."""
        self._process.stdin.write(f"{name}\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline().strip()
        return int(answer) if answer.isdecimal() else answer

    def close(self):
        self._process.stdin.close()
        assert self._process.wait(10) == 0


@pytest.fixture
def program(tmp_path):
    made = Program(tmp_path)
    yield made
    made.close()


def test_without_a_fault_everything_works(program):
    assert {name: program.do(name) for name in ALL} == dict.fromkeys(
        ALL, "ok"
    )  # before there is a control file
    program.fail()
    assert {name: program.do(name) for name in (*ALL, "read")} == dict.fromkeys((*ALL, "read"), "ok")
    assert (program.folder / "text").stat().st_size == 10_000


def test_a_full_disk_takes_a_part_of_the_bytes_and_allows_to_remove_files(program):
    program.fail(disk="full")
    assert program.do("append") == "ok"  # a part, which the program does not check
    assert (program.folder / "kept").stat().st_size == 500
    assert {name: program.do(name) for name in WRITES} == dict.fromkeys(WRITES, errno.ENOSPC)
    assert program.do("mkdir") == errno.ENOSPC
    assert [program.do(name) for name in ("replace", "remove", "read", "elsewhere")] == ["ok"] * 4
    assert 0 < (program.folder / "text").stat().st_size < 10_000
    program.fail()
    assert {name: program.do(name) for name in ALL} == dict.fromkeys(ALL, "ok")


def test_a_read_only_disk_refuses_every_change_also_on_open_files(program):
    program.fail(disk="read-only")
    changes = (*WRITES, "replace", "unlink", "mkdir")
    assert {name: program.do(name) for name in changes} == dict.fromkeys(changes, errno.EROFS)
    assert [program.do(name) for name in ("read", "elsewhere", "folder_sync")] == ["ok"] * 3
    program.fail()
    assert program.do("unlink") == "ok"


def test_fsync_fails_for_files_and_folders_and_the_bytes_are_written(program):
    program.fail(disk="failing fsync")
    assert program.do("fsync") == program.do("folder_sync") == errno.EIO
    assert (program.folder / "synced").read_bytes() == b"x"
    assert [program.do(name) for name in ("text", "replace", "remove")] == ["ok"] * 3


def test_a_slow_disk_waits_at_fsync(program):
    program.fail(disk="slow")
    began = time.monotonic()
    assert program.do("fsync") == "ok"
    assert time.monotonic() - began >= 1.0


def test_a_clock_step_moves_the_wall_clock_and_not_the_monotonic_one(program):
    program.fail(clock_s=3600.0)
    before = time.monotonic()
    wall_s, wall_ns_s, monotonic_s = eval(program.do("clock"))
    assert abs(wall_s - time.time() - 3600.0) < 5.0
    assert abs(wall_ns_s - wall_s) < 1.0
    assert before <= monotonic_s <= time.monotonic()
    program.fail(clock_s=-3600.0)
    assert abs(eval(program.do("clock"))[0] - time.time() + 3600.0) < 5.0


def test_child_processes_of_a_fork_server_fail_too(tmp_path):
    """Nodes are forked from a server that was started before the fault."""
    code = (
        "import multiprocessing, pathlib, sys\n"
        "def child(path):\n    pathlib.Path(path).write_text('x')\n"
        "if __name__ == '__main__':\n"
        "    process = multiprocessing.get_context('forkserver').Process(target=child, args=(sys.argv[1],))\n"
        "    process.start(); process.join(); print(process.exitcode)\n"
    )
    (tmp_path / "program.py").write_text(code)
    folder, control = tmp_path / "disk", tmp_path / "control.json"
    folder.mkdir()
    write_control(control, folder, disk="read-only")
    done = subprocess.run(
        [sys.executable, str(tmp_path / "program.py"), str(folder / "file")], capture_output=True, text=True,
        env={**os.environ, **environment(tmp_path / "site", control)}, timeout=60,
    )  # fmt: skip
    assert done.stdout == "1\n"
    assert "Read-only file system" in done.stderr
