"""Clock for the stamps of live sensors: common to all processes of a host, and never set back or forward.

The wall clock can jump by hours: when somebody sets it, or when a robot without a battery-backed clock first
reaches a time server. The monotonic clock does not jump, but its zero is arbitrary. Stamps are therefore the
monotonic clock plus a constant offset. The first process after a boot measures the offset and stores it in a
file; all other processes read this file.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from beamsplat.common.messages.header import local_clock_id


class StampClock:
    """Monotonic clock with the Unix epoch as its zero, aligned to the wall clock once per boot."""

    def __init__(
        self,
        folder: Path | None = None,  # of the file with the offset; default: the user's runtime folder
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._monotonic_ns = monotonic_ns
        # An interruption between the two clock readings makes the offset wrong: use the fastest of five.
        readings = []
        for _ in range(5):
            before = monotonic_ns()
            wall = wall_ns()
            readings.append((monotonic_ns() - before, wall - before))
        measured_ns = min(readings)[1]
        self.offset_ns = _shared_offset(folder or _runtime_folder(), measured_ns)

    def now_ns(self) -> int:
        """Return the current time of this clock in nanoseconds."""
        return self._monotonic_ns() + self.offset_ns


def _runtime_folder() -> Path:
    for folder in (os.environ.get("XDG_RUNTIME_DIR", ""), "/dev/shm"):
        if folder and os.access(folder, os.W_OK):
            return Path(folder)
    try:
        return Path(tempfile.gettempdir())
    except FileNotFoundError:  # all disks are full or read-only: `_shared_offset` does without a file
        return Path("/tmp")


def _shared_offset(folder: Path, measured_ns: int) -> int:
    """Return the offset (ns) from the monotonic clock to the stamp clock: the same for all processes.

    If no process has stored an offset since the boot, `measured_ns` is stored and returned. The first process
    creates the file with a hard link, which is atomic: all processes read the same value.
    """
    place = folder / f"beamsplat-clock-{os.getuid()}-{local_clock_id():016x}"
    own = folder / f".{place.name}-{os.getpid()}"
    try:
        own.write_text(str(measured_ns))
        with suppress(FileExistsError):
            os.link(own, place)
        return int(place.read_text())
    except (
        OSError,
        ValueError,
    ):  # no shared file: this process' own measurement differs from others' by microseconds
        return measured_ns
    finally:
        with suppress(OSError):
            own.unlink()
