"""Opening of data of any kind, and playback in order of arrival, with seek, loop and ticks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

from beamsplat.common.errors import UserError
from beamsplat.common.recording import is_recording
from beamsplat.common.recording.sensors import build_message
from beamsplat.services.replay.bag_files import looks_like_bag
from beamsplat.services.replay.bag_source import BagSource
from beamsplat.services.replay.bags import Bag
from beamsplat.services.replay.folder import FolderSource, looks_like_folder
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.recording_source import RecordingSource

TICK_NS = 10**9
# Between the last message of one loop and the first of the next.
_LOOP_PAUSE_NS = 100_000_000


class ReplaySource(Protocol):
    """Interface of data that can be played: a bag, a recording or a folder."""

    @property
    def start_ns(self) -> int: ...

    @property
    def end_ns(self) -> int: ...

    @property
    def problems(self) -> list[str]: ...

    def message_count(self) -> int:
        """Return the number of sensor messages."""
        ...

    def rig(self) -> Any:
        """Return the calibration as the message `Rig`."""
        ...

    def messages(self, start_ns: int = 0, stop_ns: int | None = None) -> Iterator[tuple[int, str, Any]]:
        """Yield (arrival ns, topic, message) with start_ns <= arrival < stop_ns, in order of arrival."""

    def close(self) -> None:
        """Close all files."""


def data_path(path: Path) -> Path:
    """Return `path`, or its subfolder bag/ if the folder contains ground truth and a bag (as house_a)."""
    path = Path(path)
    if path.is_dir() and not looks_like_bag(path) and looks_like_bag(path / "bag"):
        return path / "bag"
    return path


def open_source(path: Path, options: SourceOptions) -> ReplaySource:
    """Open the data at `path`, of any kind.

    Raises:
        UserError: there are no playable data at `path`, or the options do not fit the data.
    """
    path = data_path(path)
    if not path.exists():
        raise UserError(f"{path}: no such file or folder; check the path")
    if is_recording(path):
        return RecordingSource(path, options)
    if looks_like_bag(path) or path.is_file():
        bag = Bag(path, allow_truncated=options.allow_truncated)
        try:
            return BagSource(bag, options)
        except UserError:
            bag.close()
            raise
    if looks_like_folder(path):
        return FolderSource(path, options)
    raise UserError(
        f"{path}: no data found: expected a bag (.bag, .mcap, .db3 or a ROS 2 bag folder), a recording, or a "
        "folder with images/, lasers/ or scans.csv"
    )


def play(
    source: ReplaySource, *, start_s: float = 0.0, duration_s: float | None = None, loop: bool = False
) -> Iterator[tuple[int, str, Any]]:
    """Yield (arrival ns, topic, message): first the calibration, then the data, with one tick per second.

    `start_s` is relative to the first message. With `loop`, playback is endless: stamps and arrival times are
    shifted by the length of a loop, so that time never decreases.

    Raises:
        UserError: there are no data between start and end.
    """
    begin_ns = source.start_ns + round(start_s * 1e9)
    stop_ns = source.end_ns + 1
    if duration_s is not None:
        stop_ns = min(stop_ns, begin_ns + round(duration_s * 1e9))
    if begin_ns >= stop_ns:
        length_s = (source.end_ns - source.start_ns) / 1e9
        raise UserError(
            f"start_s = {start_s:g} is beyond the end of the data, which are {length_s:.1f} s long"
        )
    rig = source.rig()
    yield begin_ns, "rig", rig.model_copy(update={"stamp_ns": max(begin_ns, 0)})
    offset_ns, count = 0, 0
    next_tick_ns = begin_ns
    while True:
        played = False
        for at_ns, topic, message in source.messages(begin_ns, stop_ns):
            played = True
            at_ns += offset_ns
            while next_tick_ns <= at_ns:
                yield next_tick_ns, "tick", build_message("tick", {"stamp_ns": next_tick_ns, "count": count})
                next_tick_ns, count = next_tick_ns + TICK_NS, count + 1
            if offset_ns:
                message = message.model_copy(update={"stamp_ns": message.stamp_ns + offset_ns})
            yield at_ns, topic, message
        if not loop or not played:
            return
        offset_ns += stop_ns - begin_ns + _LOOP_PAUSE_NS
