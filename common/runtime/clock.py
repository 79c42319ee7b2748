"""Stamps of live sensors: one clock for all processes of a host, which no change of the time of day moves.

The monotonic clock cannot be set, but starts at nowhere; the time of day can be set by hours, by hand or
when a robot without a battery clock hears from a time server. Stamps are the monotonic clock plus one
offset, which the first process of a boot measures and leaves for all others.
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
    """Monotonic nanoseconds since 1970, as the time of day was when the first sensor of this boot started."""

    def __init__(
        self,
        folder: Path | None = None,  # where processes meet; default: the user's runtime folder
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._monotonic_ns = monotonic_ns
        # A moment's offset is wrong by however long the process was interrupted between the two readings.
        readings = []
        for _ in range(5):
            before = monotonic_ns()
            wall = wall_ns()
            readings.append((monotonic_ns() - before, wall - before))
        measured_ns = min(readings)[1]
        self.offset_ns = _agreed(folder or _runtime_folder(), measured_ns)

    def now_ns(self) -> int:
        """Now, on this clock."""
        return self._monotonic_ns() + self.offset_ns


def _runtime_folder() -> Path:
    for folder in (os.environ.get("XDG_RUNTIME_DIR", ""), "/dev/shm", tempfile.gettempdir()):
        if folder and os.access(folder, os.W_OK):
            return Path(folder)
    return Path(tempfile.gettempdir())


def _agreed(folder: Path, measured_ns: int) -> int:
    """The offset all processes of this boot use: the first to come links its own into place."""
    place = folder / f"beamsplat-clock-{os.getuid()}-{local_clock_id():016x}"
    own = folder / f".{place.name}-{os.getpid()}"
    try:
        own.write_text(str(measured_ns))
        with suppress(FileExistsError):
            os.link(own, place)
        return int(place.read_text())
    except (OSError, ValueError):  # no place to meet: right by itself, though not to the nanosecond
        return measured_ns
    finally:
        with suppress(OSError):
            own.unlink()
