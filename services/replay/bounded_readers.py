"""Readers of rosbags with a limit on the size of what they decompress."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection, Generator
from pathlib import Path
from typing import ClassVar

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1.reader import Chunk, decompressors
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2.reader import DirectoryReader

from beamsplat.common.errors import UserError, reason
from beamsplat.common.recording.decompression import decompress, decompress_file

_KEEP_FREE_BYTES = 1_000_000_000  # on the disk of temporary files


class BoundedReader1(Reader1):
    """Reader of ROS 1 bags; a chunk that expands too far raises ValueError when it is read."""

    def read_chunk(self) -> Chunk:
        """Return the chunk at the present position, with a decompressor that has a limit."""
        chunk = super().read_chunk()
        compression = next(name for name, function in decompressors.items() if function is chunk.decompressor)
        if compression == "none":
            return chunk
        return chunk._replace(decompressor=lambda data: decompress(data, compression))


class _DirectoryReader(DirectoryReader):
    """Reader of a folder; decompresses messages itself, because rosbags has no limit."""

    def open(self) -> None:
        super().open()
        self._by_message = self.metadata.compression_mode == "message"
        if self._by_message:
            self.metadata = self.metadata._replace(compression_mode=None)

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Yield (connection, time in ns, message) as the base class does, decompressed with a limit."""
        for connection, at_ns, data in super().messages(connections, start, stop):
            yield connection, at_ns, decompress(data, "zstd") if self._by_message else data


class BoundedReader2(Reader2):
    """Reader of ROS 2 bags; a message that expands too far raises ValueError when it is read."""

    STORAGE_PLUGINS: ClassVar = {**Reader2.STORAGE_PLUGINS, "dir": _DirectoryReader}  # type: ignore[misc]


def decompress_bag(files: list[Path], target: Path) -> list[Path]:
    """Decompress the files NAME.zstd of a ROS 2 bag to NAME in the folder `target`; return the new files.

    Raises:
        UserError: a file is damaged, or the disk has too little free space.
    """
    out = []
    for file in files:
        path = target / file.stem
        limit = shutil.disk_usage(target).free - _KEEP_FREE_BYTES
        try:
            with file.open("rb") as source, path.open("wb") as written:
                decompress_file(source, written, limit)
        except (OSError, ValueError) as error:
            raise UserError(
                f"{file}: cannot be decompressed to {tempfile.gettempdir()}: {reason(error)}; free disk "
                "space, set TMPDIR to a larger disk, or copy the file again from where it was recorded"
            ) from error
        out.append(path)
    return out
