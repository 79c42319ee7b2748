"""Small facts that outlive a process: takeover counts and a replay's position."""

from __future__ import annotations

import os
import time
from pathlib import Path

from beamsplat.common.errors import UserError

_FINISHED_NS = 2**63 - 1  # behind everything


def make_folder(path: Path) -> Path:
    """`path`, which is a folder now.

    Raises:
        UserError: it cannot be made, or is a file.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{path}: cannot make this folder ({error.strerror}): choose another") from error
    return path


def write_atomically(path: Path, data: bytes | memoryview) -> None:
    """Replaces a file so that a reader, or a crash, sees the old or the new one, never a half.

    Raises:
        OSError: the disk is full or broken; the old file is as it was, and nothing is left beside it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def _read_int(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (FileNotFoundError, ValueError):
        return None


def claim_epoch(run_dir: Path, node: str) -> int:
    """The next epoch of a node: one above the highest ever claimed, also after a crash."""
    path = make_folder(run_dir / "epochs") / node
    epoch = (_read_int(path) or 0) + 1
    write_atomically(path, str(epoch).encode())
    return epoch


class Bookmark:
    """How far a replay has come, so that a restarted one neither repeats nor skips more than a moment."""

    _PERIOD_S = 0.2

    def __init__(self, run_dir: Path, node: str) -> None:
        self._path = run_dir / "bookmarks" / node
        self._written = 0.0

    def read(self) -> int | None:
        """Arrival time, ns, of a message lately sent; None at the beginning."""
        return _read_int(self._path)

    def write(self, at_ns: int) -> None:
        """Remembers a position, a few times a second at most."""
        now = time.monotonic()
        if now - self._written >= self._PERIOD_S:
            self._written = now
            self._path.parent.mkdir(parents=True, exist_ok=True)
            temporary = self._path.with_suffix(".new")
            temporary.write_text(str(at_ns))
            temporary.replace(self._path)

    def finish(self) -> None:
        """The end was reached: a restarted replay has nothing left to send."""
        write_atomically(self._path, str(_FINISHED_NS).encode())

    def clear(self) -> None:
        """Forgets the position."""
        self._path.unlink(missing_ok=True)
