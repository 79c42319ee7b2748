"""Reader of ROS bags of any kind: topics with types and counts, raw messages by receive time.

ROS 1 (.bag, or a folder of splits), ROS 2 sqlite (.db3), MCAP (.mcap), each also compressed (.zstd) and in
folders with or without metadata.yaml. Errors are one sentence that names the file.
"""

from __future__ import annotations

import heapq
import shutil
import sqlite3
import struct
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

import apsw
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError as ReaderError2

from beamsplat.common.errors import UserError, reason
from beamsplat.common.recording.damage import describe_damage
from beamsplat.common.recording.decompression import decompress, decompress_file
from beamsplat.common.recording.mcap_file import McapFile
from beamsplat.common.recording.ros1_file import Ros1File
from beamsplat.services.replay.bag_files import find_bag_files, is_compressed
from beamsplat.services.replay.decode import RawMessage, ros1_encoding

# Exceptions of the readers on damaged files, besides their own errors.
_READ_ERRORS = (
    ReaderError2, apsw.Error, sqlite3.Error, OSError, AssertionError, KeyError, IndexError,
    ValueError, struct.error, EOFError, RuntimeError, TypeError, MemoryError, OverflowError,
)  # fmt: skip
_COPY_AGAIN = "copy it again from where it was recorded"
_KEEP_FREE_BYTES = 1_000_000_000  # on the disk of temporary files
_ZSTD = b"\x28\xb5\x2f\xfd"  # begins a zstd frame; CDR begins with a zero
_SAME_TIME = 0.5  # of the shorter file: files that overlap more are not splits of one drive


class BagTopic(NamedTuple):
    """One topic of a bag; `type_name` has the form pkg/msg/Type also for ROS 1."""

    name: str
    type_name: str
    count: int  # type: ignore[assignment]  # hides tuple.count, which nothing needs
    encoding: str  # "cdr", "ros1", or an unsupported encoding


class Bag:
    """An open ROS bag.

    Raises:
        UserError: no such file, not a bag, truncated (unless `allow_truncated`), or without messages.
    """

    def __init__(self, path: Path, *, allow_truncated: bool = False) -> None:
        self.path = Path(path)
        self._notes: list[str] = []
        self._stack = ExitStack()
        self._bag_files: list[_BagFile] = []
        try:
            found = find_bag_files(self.path)
            self._notes += found.notes
            for file in found.files:
                part = self._open(self._decompressed(file), file, allow_truncated)
                if not self._is_duplicate(part):
                    self._bag_files.append(part)
            if not any(topic.count for part in self._bag_files for topic in part.topics):
                raise UserError(f"{self.path}: the bag has no messages; record again")
        except UserError:
            self.close()
            raise

    @property
    def problems(self) -> list[str]:
        """Return sentences about missing and damaged parts of the bag that were found so far."""
        damaged = [
            describe_damage(part.file, part.damaged_ns, part.span_ns[0], part.span_ns[1])
            for part in self._bag_files
            if part.span_ns
        ]
        return [*self._notes, *(text for text in damaged if text)]

    @property
    def topics(self) -> list[BagTopic]:
        """Return the topics, sorted by name, with counts summed over the files of the bag."""
        found: dict[tuple[str, str, str], int] = {}
        for part in self._bag_files:
            for topic in part.topics:
                key = (topic.name, topic.type_name, topic.encoding)
                found[key] = found.get(key, 0) + topic.count
        return [BagTopic(name, kind, count, code) for (name, kind, code), count in sorted(found.items())]

    @property
    def start_ns(self) -> int:
        return min(part.span_ns[0] for part in self._bag_files if part.span_ns)

    @property
    def end_ns(self) -> int:
        """Return the receive time of the last message."""
        return max(part.span_ns[1] for part in self._bag_files if part.span_ns)

    def messages(
        self, topics: Collection[str] | None = None, start_ns: int = 0, stop_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield raw messages with start_ns <= at_ns < stop_ns, in order of receive time.

        `topics`: names of the topics to read; None = all.

        Raises:
            UserError: the file is damaged.
        """
        stop_ns = 2**63 - 1 if stop_ns is None else stop_ns
        streams = [part.messages(topics, start_ns, stop_ns) for part in self._bag_files]
        last_ns = start_ns
        try:
            for message in heapq.merge(*streams, key=lambda raw: raw.at_ns):
                last_ns = message.at_ns
                yield message
        except _READ_ERRORS as error:
            if isinstance(error, UserError):
                raise
            after_s = (last_ns - self.start_ns) / 1e9
            raise UserError(
                f"{self.path}: damaged {after_s:.1f} s after its start ({_reason(error)}); {_COPY_AGAIN}"
            ) from error

    def close(self) -> None:
        self._stack.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, file: Path, shown: Path, allow_truncated: bool) -> _BagFile:
        """Open one file; `shown`: its path before decompression, for texts."""
        if file.stat().st_size == 0:
            raise UserError(f"{shown}: the file is empty; {_COPY_AGAIN}")
        if ".mcap" in file.suffixes or ".bag" in file.suffixes:
            part: _BagFile
            if ".mcap" in file.suffixes:
                part = _McapFile(self._stack.enter_context(McapFile(file)), shown)
            else:
                opened = Ros1File(file)
                self._stack.callback(opened.close)
                part = _Ros1File(opened, shown)
            if part.truncated:
                sentence = f"{shown}: truncated: {part.truncated}"
                if not allow_truncated:
                    raise UserError(
                        f"{sentence}; {_COPY_AGAIN}{_repair(file)}, or set allow_truncated to use the "
                        "readable part"
                    )
                self._notes.append(sentence)
            if shown.suffix == ".active":
                self._notes.append(f"{shown}: the recorder has not closed this file: its end may be missing")
            return part
        try:
            reader = Reader2(file)
            reader.open()
        except _READ_ERRORS as error:
            raise UserError(_explain(shown, error)) from error
        self._stack.callback(_close, reader)
        return _SqliteFile(reader, shown)

    def _decompressed(self, file: Path) -> Path:
        """Return a file, decompressed to a temporary folder if its name ends in .zstd.

        Raises:
            UserError: the file is damaged, or the disk has too little free space.
        """
        if not is_compressed(file):
            return file
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="beamsplat-bag-")))
        target = folder / file.stem
        limit = shutil.disk_usage(folder).free - _KEEP_FREE_BYTES
        try:
            with file.open("rb") as source, target.open("wb") as written:
                decompress_file(source, written, limit)
        except (OSError, ValueError) as error:
            raise UserError(
                f"{file}: cannot be decompressed to {tempfile.gettempdir()}: {reason(error)}; free disk "
                "space, set TMPDIR to a larger disk, or copy the file again from where it was recorded"
            ) from error
        return target

    def _is_duplicate(self, part: _BagFile) -> bool:
        """Return whether a file has the same messages as an earlier one, with a sentence about it.

        Raises:
            UserError: it has the same topics at the same time, but not the same messages: another drive.
        """
        for other in self._bag_files:
            if not part.span_ns or not other.span_ns:
                continue
            shorter_ns = min(end - start for start, end in (part.span_ns, other.span_ns))
            both_ns = min(part.span_ns[1], other.span_ns[1]) - max(part.span_ns[0], other.span_ns[0])
            shared = _repeated_topics(part) & _repeated_topics(other)
            if not shared or both_ns <= _SAME_TIME * shorter_ns:
                continue
            if sorted(part.topics) == sorted(other.topics) and part.span_ns == other.span_ns:
                self._notes.append(
                    f"{self.path}: {part.file.name} has the same messages as {other.file.name}: not read"
                )
                return True
            raise UserError(
                f"{self.path}: {other.file.name} and {part.file.name} have the same topics "
                f"({', '.join(sorted(shared))}) at the same time: give one file, not the folder"
            )
        return False


class _BagFile(ABC):
    """One file of a bag (a bag may be split into several)."""

    file: Path
    topics: list[BagTopic]
    span_ns: tuple[int, int] | None
    truncated: str = ""

    @property
    def damaged_ns(self) -> list[tuple[int, int]]:
        """Return the first and last receive time of each damaged chunk found so far."""
        return []

    @abstractmethod
    def messages(self, topics: Collection[str] | None, start_ns: int, stop_ns: int) -> Iterator[RawMessage]:
        """Yield messages of the topics (None = all) with start_ns <= at_ns < stop_ns, by receive time."""


class _McapFile(_BagFile):
    def __init__(self, opened: McapFile, file: Path) -> None:
        self.file, self._opened, self.truncated = file, opened, opened.truncated
        self.span_ns = (opened.start_ns, opened.end_ns) if opened.counts.total() else None
        self.topics = [
            BagTopic(channel.topic, self._type_of(channel), opened.counts[i], channel.message_encoding)
            for i, channel in opened.channels.items()
        ]

    @property
    def damaged_ns(self) -> list[tuple[int, int]]:
        return list(self._opened.damaged.values())

    def _type_of(self, channel: Any) -> str:
        schema = self._opened.schemas.get(channel.schema_id)
        if schema is None:
            return channel.metadata.get("beamsplat.schema", "unknown")
        return _ros2_type(schema.name)

    def messages(self, topics: Collection[str] | None, start_ns: int, stop_ns: int) -> Iterator[RawMessage]:
        channels = self._opened.channels
        ids = [i for i, channel in channels.items() if topics is None or channel.topic in topics]
        types = {i: self._type_of(channels[i]) for i in ids}
        for channel, message in self._opened.messages(ids, start_ns, stop_ns):
            yield RawMessage(
                message.log_time, channel.topic, types[channel.id], _message_data(message.data),
                channel.message_encoding,
            )  # fmt: skip


class _Ros1File(_BagFile):
    def __init__(self, opened: Ros1File, file: Path) -> None:
        self.file, self._opened, self.truncated = file, opened, opened.truncated
        self.span_ns = (opened.start_ns, opened.end_ns) if opened.counts.total() else None
        self._topics = {
            number: BagTopic(
                connection.topic, _ros2_type(connection.type_name), opened.counts[number],
                ros1_encoding(_ros2_type(connection.type_name), connection.md5),
            )
            for number, connection in opened.connections.items()
        }  # fmt: skip
        self.topics = list(self._topics.values())

    @property
    def damaged_ns(self) -> list[tuple[int, int]]:
        return list(self._opened.damaged.values())

    def messages(self, topics: Collection[str] | None, start_ns: int, stop_ns: int) -> Iterator[RawMessage]:
        wanted = [n for n, topic in self._topics.items() if topics is None or topic.name in topics]
        for message in self._opened.messages(wanted, start_ns, stop_ns):
            topic = self._topics[message.connection]
            yield RawMessage(message.at_ns, topic.name, topic.type_name, message.data, topic.encoding)


class _SqliteFile(_BagFile):
    def __init__(self, reader: Reader2, file: Path) -> None:
        self.file, self._reader = file, reader
        self._encodings = {
            id(c): getattr(c.ext, "serialization_format", "cdr") for c in reader.connections
        }  # fmt: skip
        self.topics = [
            BagTopic(c.topic, c.msgtype, c.msgcount, self._encodings[id(c)]) for c in reader.connections
        ]
        # rosbags' end_time is one past the last message.
        self.span_ns = (reader.start_time, reader.end_time - 1) if reader.message_count else None

    def messages(self, topics: Collection[str] | None, start_ns: int, stop_ns: int) -> Iterator[RawMessage]:
        chosen = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not chosen:
            return
        for connection, at_ns, data in self._reader.messages(chosen, start_ns, stop_ns):
            encoding = self._encodings.get(id(connection), "cdr")
            yield RawMessage(
                at_ns, connection.topic, connection.msgtype, _message_data(bytes(data)), encoding
            )


def _message_data(data: bytes) -> bytes:
    """Return a serialised message, decompressed if the bag has its messages compressed one by one."""
    return decompress(data, "zstd") if data[:4] == _ZSTD else data


def _ros2_type(name: str) -> str:
    """Return the name of a type in the form pkg/msg/Type; other names are returned unchanged."""
    package, _, last = name.partition("/")
    return name if "/msg/" in name or not last else f"{package}/msg/{last}"


def _repeated_topics(part: _BagFile) -> set[str]:
    """Return the topics with several messages: splits repeat latched ones."""
    return {topic.name for topic in part.topics if topic.count > 2 and not topic.name.endswith("tf_static")}


def _repair(file: Path) -> str:
    return f", repair it with `rosbag reindex {file.name}`" if ".bag" in file.suffixes else ""


def _explain(file: Path, error: Exception) -> str:
    """Return one sentence about a file of a ROS 2 bag that could not be opened."""
    text = _reason(error)
    if "file is not a database" in text or "missing tables" in text:
        return f"{file}: not a bag, in spite of its name ({text})"
    if isinstance(error, (apsw.Error, AssertionError, struct.error, IndexError, ValueError)):
        return f"{file}: truncated or damaged ({text}); {_COPY_AGAIN}"
    return f"{file}: cannot be read ({text}); {_COPY_AGAIN}"


def _reason(error: Exception) -> str:
    text = " ".join(str(argument) for argument in error.args).strip().split("\n")[0]
    return text.rstrip(".")[:200] or type(error).__name__


def _close(reader: Reader2) -> None:
    with suppress(*_READ_ERRORS):  # closing a damaged file may raise again
        reader.close()
