"""A disk that fails, or a process that is killed, at a chosen system call that changes files."""

import builtins
import contextlib
import errno
import io
import os

_CALLS = ("open", "fsync", "fdatasync", "replace", "rename", "unlink", "mkdir", "scandir", "close")


class _Raw(io.FileIO):
    """A file whose calls are counted; a call that fails has written the first half of its data."""

    def __init__(self, disk, path, mode, opener):
        super().__init__(path, mode, opener=opener)
        self._disk = disk

    def write(self, data):
        data = memoryview(data).cast("B")
        self._disk.step("write", lambda: super(_Raw, self).write(data[: len(data) // 2]))
        return super().write(data)

    def close(self):
        if self.closed:
            return
        super().close()
        self._disk.step("close")


class FaultyDisk:
    """Context in which call number `at` (from 0) fails: with an OSError, with all later ones, or by a kill.

    `calls` has the names of the calls so far. Threads of the process are affected too.
    """

    def __init__(self, at=None, how="once", number=errno.EIO):
        self.at, self.how, self.number, self.calls = at, how, number, []

    def step(self, name, before=lambda: None):
        position = len(self.calls)
        self.calls.append(name)
        if self.at is None or position < self.at or (position > self.at and self.how == "once"):
            return
        before()
        if self.how == "kill":
            os._exit(9)
        raise OSError(self.number, os.strerror(self.number), name)

    def _open(
        self,
        path,
        mode="r",
        buffering=-1,
        encoding=None,
        errors=None,
        newline=None,
        closefd=True,
        opener=None,
    ):
        self.step("open")
        if not set(mode) & set("wxa+") or isinstance(path, int):
            return self._real_open(path, mode, buffering, encoding, errors, newline, closefd, opener)
        raw = _Raw(self, path, mode.replace("b", "").replace("t", ""), opener)
        file = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        return file if "b" in mode else io.TextIOWrapper(file, encoding, errors, newline)

    def __enter__(self):
        self._undo = contextlib.ExitStack()
        self._real_open = io.open
        for module in (io, builtins):
            self._undo.callback(setattr, module, "open", module.open)
            module.open = self._open
        for name in _CALLS:
            real = getattr(os, name)

            def call(*args, _real=real, _name=name, **kwargs):
                if _name == "close":  # an error of `close` leaves the descriptor closed
                    _real(*args)
                self.step(_name)
                return None if _name == "close" else _real(*args, **kwargs)

            self._undo.callback(setattr, os, name, real)
            setattr(os, name, call)
        return self

    def __exit__(self, *exception):
        self._undo.close()


def killed_at(at, run):
    """Run `run` in a child process that is killed at call `at`; return whether it was killed."""
    child = os.fork()
    if child == 0:
        with FaultyDisk(at, "kill"):
            run()
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
