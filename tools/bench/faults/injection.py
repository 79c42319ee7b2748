"""Faults of disk and clock inside the processes of a system, without privileges and without a compiler.

`environment` returns variables with which a Python process, and all that it starts, runs `install` before its
own code: a generated `sitecustomize.py` on PYTHONPATH. Python's functions that write files then consult a
control file. Only the standard library is used, so that nothing of the system is imported earlier than usual.

Not covered: writes by native code (rerun's files, the log lines of a process through its standard error),
and Zenoh's own time stamps.
"""

from __future__ import annotations

import builtins
import errno
import io
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

VARIABLE = "BEAMSPLAT_FAULTS"  # path of the control file
DiskMode = Literal["", "full", "read-only", "failing fsync", "slow"]
DISK_MODES: tuple[DiskMode, ...] = ("full", "read-only", "failing fsync", "slow")
_SLOW_WRITE_S, _SLOW_FSYNC_S = 0.05, 1.0  # an SD card that erases blocks
_ERRNO = {"full": errno.ENOSPC, "read-only": errno.EROFS}
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_SITE = """import importlib.util
spec = importlib.util.spec_from_file_location("injected_faults", {source!r})
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
module.install()
"""


def environment(folder: Path, control: Path) -> dict[str, str]:
    """Return the variables to add to the environment of a process; `sitecustomize.py` is written to `folder`.

    Raises:
        OSError: the file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sitecustomize.py").write_text(_SITE.format(source=str(Path(__file__).resolve())))
    before = os.environ.get("PYTHONPATH", "")
    return {"PYTHONPATH": f"{folder}{os.pathsep}{before}" if before else str(folder), VARIABLE: str(control)}


def write_control(
    control: Path, folder: Path, *, disk: DiskMode = "", clock_s: float = 0.0, sensors: str = ""
) -> None:
    """Replace the control file, which the processes read before their next operation.

    Args:
        control: the file.
        folder: the disk that the faults affect: all files below this folder.
        disk: fault of the disk.
        clock_s: offset of the wall clock.
        sensors: fault of the sensor data, see `faulty_replay`.

    Raises:
        OSError: the file cannot be written.
    """
    table = {"folder": str(folder.resolve()), "disk": disk, "clock_s": clock_s, "sensors": sensors}
    fresh = control.with_suffix(".new")
    fresh.write_text(json.dumps(table))
    fresh.replace(control)


class InjectedState:
    """Current contents of the control file; it is read again after it was replaced."""

    def __init__(self, control: Path) -> None:
        self._control = str(control)
        self._stat, self._open = os.stat, io.open  # `install` replaces the second
        self._seen: tuple[int, int] | None = None
        self._table: dict[str, Any] = {}

    def get(self, field: str) -> Any:
        """Return a field of the control file; None if there is no file."""
        try:
            found = self._stat(self._control)
            seen = (found.st_mtime_ns, found.st_ino)
            if seen != self._seen:
                with self._open(self._control) as file:
                    self._table = json.load(file)
                self._seen = seen
        except (OSError, ValueError):
            return None
        return self._table.get(field)

    def disk_mode(self, path: object) -> DiskMode:
        """Return the fault of the disk on which `path` (a path or a file descriptor) is, or ""."""
        mode = self.get("disk")
        if not mode:
            return ""
        try:
            if isinstance(path, int):
                path = os.readlink(f"/proc/self/fd/{path}")
            text = os.path.abspath(os.fsdecode(path))  # type: ignore[arg-type]  # else TypeError
        except (OSError, TypeError):
            return ""
        return mode if f"{text}{os.sep}".startswith(self._table["folder"] + os.sep) else ""

    def change(self, path: object, what: str) -> None:
        """Raise what this disk would raise before it changes `path`: creates, renames or removes it."""
        mode = self.disk_mode(path)
        if mode == "read-only" or (mode == "full" and what == "create folder"):
            _fail(mode, path)
        if mode == "slow":
            time.sleep(_SLOW_WRITE_S)

    def allowed_bytes(self, path: object, size: int, cut: bool) -> int:
        """Return how many of `size` bytes can be written; a disk that becomes full takes half of them.

        Raises:
            OSError: nothing can be written; `cut` says that the previous write was cut already.
        """
        mode = self.disk_mode(path)
        if mode == "read-only" or (mode == "full" and (cut or size < 2)):
            _fail(mode, path)
        if mode == "slow":
            time.sleep(_SLOW_WRITE_S)
        return size // 2 if mode == "full" else size

    def sync(self, descriptor: int) -> None:
        """Raise what this disk would raise at fsync."""
        mode = self.disk_mode(descriptor)
        if mode == "failing fsync":
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        if mode == "slow":
            time.sleep(_SLOW_FSYNC_S)


def _fail(mode: str, path: object) -> None:
    number = _ERRNO[mode]
    raise OSError(number, os.strerror(number), path if isinstance(path, str) else None)


def _file_class(state: InjectedState) -> type[io.FileIO]:
    class InjectedFile(io.FileIO):
        """An unbuffered file whose writes consult the control file."""

        _cut = False

        def write(self, data: Any) -> int:
            view = memoryview(data).cast("B")
            allowed = state.allowed_bytes(self.name, len(view), self._cut)
            self._cut = allowed < len(view)
            return super().write(view[:allowed]) or 0

    return InjectedFile


def install() -> None:
    """Make Python's functions for files and wall clock consult the control file that `VARIABLE` names."""
    control = os.environ.get(VARIABLE)
    if control is None:
        return
    state = InjectedState(Path(control))
    _install_clock(state)
    _install_files(state)


def _install_clock(state: InjectedState) -> None:
    real_s, real_ns = time.time, time.time_ns
    time.time = lambda: real_s() + (state.get("clock_s") or 0.0)
    time.time_ns = lambda: real_ns() + round((state.get("clock_s") or 0.0) * 1e9)


def _install_files(state: InjectedState) -> None:
    real_open, real_os_open, real_write = io.open, os.open, os.write
    file_class = _file_class(state)

    def open_file(
        file: Any, mode: str = "r", buffering: int = -1, encoding: str | None = None,
        errors: str | None = None, newline: str | None = None, closefd: bool = True, opener: Any = None,
    ) -> Any:  # fmt: skip
        if not set(mode) & set("wxa+") or isinstance(file, int):
            return real_open(file, mode, buffering, encoding, errors, newline, closefd, opener)
        state.change(file, "open")
        raw = file_class(file, mode.replace("b", "").replace("t", ""), closefd, opener)
        if buffering == 0:
            return raw
        size = buffering if buffering > 1 else io.DEFAULT_BUFFER_SIZE
        buffered = io.BufferedRandom(raw, size) if "+" in mode else io.BufferedWriter(raw, size)
        if "b" in mode:
            return buffered
        return io.TextIOWrapper(buffered, encoding, errors, newline, line_buffering=buffering == 1)

    def os_open(path: Any, flags: int, *rest: Any, **more: Any) -> int:
        if flags & _WRITES:
            state.change(path, "open")
        return real_os_open(path, flags, *rest, **more)

    def os_write(descriptor: int, data: Any) -> int:
        state.allowed_bytes(descriptor, len(data), cut=True)
        return real_write(descriptor, data)

    io.open = builtins.open = open_file
    vars(__import__("_io"))["open"] = open_file  # `tempfile` uses this name
    os.open, os.write = os_open, os_write
    for name in ("fsync", "fdatasync"):
        setattr(os, name, _before(getattr(os, name), lambda descriptor, *_: state.sync(
            descriptor if isinstance(descriptor, int) else descriptor.fileno())))  # fmt: skip
    changes = {"replace": "rename", "rename": "rename", "unlink": "remove", "remove": "remove",
               "rmdir": "remove", "mkdir": "create folder", "truncate": "write"}  # fmt: skip
    for name, what in changes.items():
        setattr(os, name, _before(getattr(os, name), lambda path, *_, what=what: state.change(path, what)))


def _before(real: Callable[..., Any], check: Callable[..., None]) -> Callable[..., Any]:
    def checked(*arguments: Any, **more: Any) -> Any:
        check(*arguments)
        return real(*arguments, **more)

    return checked
