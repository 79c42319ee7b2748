"""Small persistent state: atomic file replacement, and the position of a replay."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path

from beamsplat.common.errors import UserError, reason

log = logging.getLogger("beamsplat")

_FINISHED_NS = 2**63 - 1  # int64 maximum: later than any message


def make_folder(path: Path) -> Path:
    """Create a folder with its parents, if it does not exist, and return its path.

    Raises:
        UserError: the folder cannot be created, or `path` is a file.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{path}: cannot create this folder ({error.strerror}): choose another") from error
    return path


def read_limited(path: Path, limit_bytes: int) -> bytes:
    """Return the content of a file of at most `limit_bytes`, which bounds the memory.

    Raises:
        OSError: it cannot be read.
        ValueError: it is longer.
    """
    with path.open("rb") as file:
        data = file.read(limit_bytes + 1)
    if len(data) > limit_bytes:
        raise ValueError(f"longer than {limit_bytes} bytes")
    return data


def is_disk_fault(error: OSError) -> bool:
    """Return whether a disk is full, read-only or broken, in contrast to a path that a user has mistyped."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)


def make_folder_if_possible(path: Path) -> str:
    """Create a folder as `make_folder` does; return "", or why its disk does not permit it.

    Raises:
        UserError: the folder cannot be created for another reason.
    """
    try:
        make_folder(path)
    except UserError as error:
        if isinstance(error.__cause__, OSError) and is_disk_fault(error.__cause__):
            return reason(error.__cause__)
        raise
    return ""


def check_can_write(path: Path, option: str, read_only_disk: bool = False) -> None:
    """Check that a file or folder can be written, without creating anything.

    Args:
        path: need not exist; in that case, its nearest existing parent folder is checked.
        option: name of the option that contains the path, for the error text.
        read_only_disk: accept a disk that is mounted read-only: a node starts, and writes when it can.

    Raises:
        UserError: no permission, or a parent is a file.
    """
    nearest = path.expanduser().absolute()
    try:
        while not nearest.exists() and nearest != nearest.parent:
            nearest = nearest.parent
    except OSError as error:
        raise UserError(f"{option} = {path}: {error.strerror}") from error
    if nearest != path.expanduser().absolute() and not nearest.is_dir():
        raise UserError(f"{option} = {path}: {nearest} is a file, not a folder; choose another place")
    if not os.access(nearest, os.W_OK):
        if read_only_disk and os.statvfs(nearest).f_flag & os.ST_RDONLY:
            return
        raise UserError(f"{option} = {path}: {nearest} cannot be written; choose another place")


def write_atomically(path: Path, data: bytes | memoryview, mode: int = 0o666) -> None:
    """Write a file by fsync and rename: a reader, or a crash, sees the old or the new content, never a part.

    `mode`: permissions of the file; the umask of the process reduces them.

    Raises:
        OSError: writing failed, for example disk full; the old file is unchanged, the temporary one removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(temporary, "wb", opener=lambda path, flags: os.open(path, flags, mode)) as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


def write_durably(path: Path, data: bytes | memoryview) -> None:
    """Replace a file atomically and flush its folder, so that the new file survives a power failure.

    Raises:
        OSError: writing failed: the old file is unchanged; or the folder could not be flushed: the new file
            is in place, but a power failure may bring the old one back.
    """
    write_atomically(path, data)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Flush a folder to the disk (fsync), so that files created, renamed or removed in it stay so.

    Raises:
        OSError: the disk is broken.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _read_int(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


class ReplayPosition:
    """Persistent position of a replay: a restarted replay repeats or skips at most `_PERIOD_S` of data.

    Faults of the disk are logged once; the replay continues, and would start at its last stored position.
    """

    _PERIOD_S = 0.2  # between two writes: limits the disk load

    def __init__(self, run_dir: Path, node: str) -> None:
        self._path = run_dir / "bookmarks" / node
        self._written = 0.0
        self._fault_logged = False

    def read(self) -> int | None:
        """Return the arrival time (ns) of a recently sent message; None if there is no stored position."""
        return _read_int(self._path)

    def write(self, at_ns: int) -> None:
        """Store a position (ns); calls within `_PERIOD_S` of the last write do nothing."""
        now = time.monotonic()
        if now - self._written >= self._PERIOD_S:
            self._written = now
            with self._faults_logged():
                self._path.parent.mkdir(parents=True, exist_ok=True)
                temporary = self._path.with_suffix(".new")
                temporary.write_text(str(at_ns))
                temporary.replace(self._path)

    def finish(self) -> None:
        """Mark the replay as complete: a restarted replay sends nothing."""
        with self._faults_logged():
            write_atomically(self._path, str(_FINISHED_NS).encode())

    def clear(self) -> None:
        """Remove the stored position."""
        with self._faults_logged():
            self._path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _faults_logged(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if not self._fault_logged:
                self._fault_logged = True
                log.warning("%s: the position of the replay is not stored (%s)", self._path, reason(error))
