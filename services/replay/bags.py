"""Reader of ROS bags of any kind: topics with types and counts, raw messages by receive time.

ROS 1 (.bag, or a folder of splits), ROS 2 sqlite (.db3), MCAP (.mcap), and ROS 2 folders with or
without metadata.yaml. Errors are one sentence that names the file.
"""

from __future__ import annotations

import heapq
import re
import sqlite3
import struct
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

import apsw
from rosbags.rosbag1 import ReaderError as ReaderError1
from rosbags.rosbag2 import ReaderError as ReaderError2

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import read_limited
from beamsplat.common.recording.decompression import decompress
from beamsplat.common.recording.mcap_file import McapFile
from beamsplat.services.replay.bounded_readers import BoundedReader1, BoundedReader2, decompress_bag
from beamsplat.services.replay.decode import RawMessage

# Exceptions of the readers on damaged files, besides their own errors.
_READ_ERRORS = (
    ReaderError1, ReaderError2, apsw.Error, sqlite3.Error, OSError, AssertionError, KeyError, IndexError,
    ValueError, struct.error, EOFError, RuntimeError, TypeError, MemoryError, OverflowError,
)  # fmt: skip
_MAX_METADATA_BYTES = 4_000_000  # of metadata.yaml; with hundreds of topics it has less than 1 MB
_COPY_AGAIN = "copy it again from where it was recorded"


class BagTopic(NamedTuple):
    """One topic of a bag; `type_name` has the form pkg/msg/Type also for ROS 1."""

    name: str
    type_name: str
    count: int  # type: ignore[assignment]  # hides tuple.count, which nothing needs
    encoding: str  # "cdr", "ros1", or an unsupported encoding


class Bag:
    """An open ROS bag. `problems` are sentences about missing parts of the bag.

    Raises:
        UserError: no such file, not a bag, truncated (unless `allow_truncated`), or without messages.
    """

    def __init__(self, path: Path, *, allow_truncated: bool = False) -> None:
        self.path = Path(path)
        self.problems: list[str] = []
        self._stack = ExitStack()
        self._bag_files: list[_BagFile] = []
        try:
            files = _files(self.path)
            if files[0].suffix == ".zstd":
                folder = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="beamsplat-bag-"))
                files = decompress_bag(files, Path(folder))
            for file in files:
                self._bag_files.append(self._open(file, allow_truncated))
            if not any(topic.count for part in self._bag_files for topic in part.topics):
                raise UserError(f"{self.path}: the bag has no messages; record again")
        except UserError:
            self.close()
            raise

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

    def _open(self, file: Path, allow_truncated: bool) -> _BagFile:
        if file.suffix == ".mcap":
            by_message = _compression_mode(self.path / "metadata.yaml") == "message"
            part = _McapFile(self._stack.enter_context(McapFile(file)), by_message)
            if part.file.truncated:
                sentence = f"{file}: truncated: {part.file.truncated}"
                if not allow_truncated:
                    raise UserError(
                        f"{sentence}; {_COPY_AGAIN}, or set allow_truncated to use the readable part"
                    )
                self.problems.append(sentence)
            return part
        try:
            reader = BoundedReader1(file) if file.suffix == ".bag" else BoundedReader2(file)
            reader.open()
        except _READ_ERRORS as error:
            raise UserError(_explain(file, error)) from error
        self._stack.callback(_close, reader)
        return _RosbagsFile(reader)


class _BagFile(ABC):
    """One file of a bag (a bag may be split into several)."""

    topics: list[BagTopic]
    span_ns: tuple[int, int] | None

    @abstractmethod
    def messages(self, topics: Collection[str] | None, start_ns: int, stop_ns: int) -> Iterator[RawMessage]:
        """Yield messages of the topics (None = all) with start_ns <= at_ns < stop_ns, by receive time."""


class _McapFile(_BagFile):
    def __init__(self, file: McapFile, by_message: bool) -> None:
        """`by_message`: each message is compressed separately."""
        self.file, self._by_message = file, by_message
        self.span_ns = (file.start_ns, file.end_ns) if file.counts.total() else None
        self.topics = [
            BagTopic(channel.topic, self._type_of(channel), file.counts[i], channel.message_encoding)
            for i, channel in file.channels.items()
        ]

    def _type_of(self, channel: Any) -> str:
        schema = self.file.schemas.get(channel.schema_id)
        if schema is None:
            return channel.metadata.get("beamsplat.schema", "unknown")
        package, _, name = schema.name.partition("/")
        return schema.name if "/msg/" in schema.name or not name else f"{package}/msg/{name}"

    def messages(self, topics: Collection[str] | None, start_ns: int, stop_ns: int) -> Iterator[RawMessage]:
        ids = [i for i, channel in self.file.channels.items() if topics is None or channel.topic in topics]
        types = {i: self._type_of(self.file.channels[i]) for i in ids}
        for channel, message in self.file.messages(ids, start_ns, stop_ns):
            data = decompress(message.data, "zstd") if self._by_message else message.data
            yield RawMessage(
                message.log_time, channel.topic, types[channel.id], data, channel.message_encoding
            )


class _RosbagsFile(_BagFile):
    def __init__(self, reader: BoundedReader1 | BoundedReader2) -> None:
        self._reader = reader
        ros1 = isinstance(reader, BoundedReader1)
        self._encodings = {
            id(c): "ros1" if ros1 else getattr(c.ext, "serialization_format", "cdr")
            for c in reader.connections
        }
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
            yield RawMessage(at_ns, connection.topic, connection.msgtype, bytes(data), encoding)


def looks_like_bag(path: Path) -> bool:
    """Return whether `path` is a bag, judged by its name or by the names of the files in it."""
    if path.is_dir():
        names = {file.suffix for file in path.iterdir()}
        return bool(names & {".mcap", ".db3", ".bag", ".zstd"}) or (path / "metadata.yaml").exists()
    return path.suffix in (".bag", ".mcap", ".db3")


def _files(path: Path) -> list[Path]:
    """Return the files to open for `path`; for a folder that rosbags opens as a whole, the folder."""
    if not path.exists():
        raise UserError(f"{path}: no such file or folder; check the path")
    if path.is_file():
        if path.suffix not in (".bag", ".mcap", ".db3"):
            raise UserError(f"{path}: not a bag; expected .bag, .mcap, .db3, or a folder with one of them")
        return [path]
    metadata = path / "metadata.yaml"
    if mcaps := sorted(path.glob("*.mcap")):
        return mcaps
    if _compression_mode(metadata) == "file" and (compressed := sorted(path.glob("*.zstd"))):
        return compressed
    if metadata.exists():
        return [path]
    files = sorted(path.glob("*.db3")) or sorted(path.glob("*.bag"))
    if not files:
        raise UserError(f"{path}: not a bag: no metadata.yaml and no .mcap, .db3 or .bag file in this folder")
    return files


def _compression_mode(metadata: Path) -> str:
    """Return the compression mode in a metadata.yaml, in lower case: "file", "message", or "" for none.

    Raises:
        UserError: the file cannot be read, or is too long: the reader of bags would need minutes for it.
    """
    if not metadata.is_file():
        return ""
    try:
        text = read_limited(metadata, _MAX_METADATA_BYTES).decode(errors="replace")
    except (OSError, ValueError) as error:
        raise UserError(f"{metadata}: cannot be read ({reason(error)}); {_COPY_AGAIN}") from error
    found = re.search(r"compression_mode:\s*['\"]?(file|message)", text, re.I)
    return found[1].lower() if found else ""


def _explain(file: Path, error: Exception) -> str:
    """Return one sentence about a bag that could not be opened."""
    if file.is_file() and file.stat().st_size == 0:
        return f"{file}: the file is empty; {_COPY_AGAIN}"
    reason = _reason(error)
    if "magic" in reason or "file is not a database" in reason or "missing tables" in reason:
        return f"{file}: not a bag, in spite of its name ({reason})"
    if "not indexed" in reason:
        return f"{file}: the recording was not closed; repair it with `rosbag reindex {file.name}`"
    if isinstance(error, (ReaderError1, apsw.Error, AssertionError, struct.error, IndexError, ValueError)):
        return f"{file}: truncated or damaged ({reason}); {_COPY_AGAIN}"
    return f"{file}: cannot be read ({reason}); {_COPY_AGAIN}"


def _reason(error: Exception) -> str:
    text = " ".join(str(argument) for argument in error.args).strip().split("\n")[0]
    return text.rstrip(".")[:200] or type(error).__name__


def _close(reader: BoundedReader1 | BoundedReader2) -> None:
    with suppress(*_READ_ERRORS):  # closing a damaged file may raise again
        reader.close()
