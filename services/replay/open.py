"""Access to recordings for programs that are not nodes: `beamsplat.open_recording`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from beamsplat.common.messages import Message, Rig
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.source import ReplaySource, open_source, play


class OpenRecording:
    """A bag, a recording or a folder, opened for reading; a context manager that closes the files."""

    def __init__(self, source: ReplaySource) -> None:
        self._source = source

    @property
    def rig(self) -> Rig:
        """Return the calibration; `rig.assumed` lists the values that the data do not contain."""
        return self._source.rig()

    @property
    def problems(self) -> list[str]:
        """Return the faults found in the data, one sentence each."""
        return list(self._source.problems)

    def messages(
        self, start_s: float = 0.0, duration_s: float | None = None
    ) -> Iterator[tuple[str, Message]]:
        """Yield (topic, message) in order of arrival: `rig` first, then `lidar/scan`, `camera/image`, ...

        Args:
            start_s: seconds after the first message at which to start.
            duration_s: seconds to read; None = to the end.

        Raises:
            UserError: `start_s` is beyond the end of the data.
        """
        for _, topic, message in play(self._source, start_s=start_s, duration_s=duration_s):
            if topic != "tick":
                yield topic, message

    def close(self) -> None:
        """Close the files."""
        self._source.close()

    def __enter__(self) -> OpenRecording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_recording(path: str | Path, **options: Any) -> OpenRecording:
    """Open a ROS 1 or ROS 2 bag, a recording of BeamSplat, or a folder of images and scans.

    Args:
        path: a file or folder.
        options: fields of `SourceOptions`, for example `scan_topic="/scan"` or `rig=Path("rig.toml")`.

    Raises:
        UserError: there are no readable data at `path`, or an option does not fit the data.

    Example:
        >>> with beamsplat.open_recording("drive/bag") as recording:  # doctest: +SKIP
        ...     scans = [message for topic, message in recording.messages() if topic == "lidar/scan"]
    """
    return OpenRecording(open_source(Path(path), SourceOptions(**options)))
