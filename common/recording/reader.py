"""Reader of BeamSplat recordings: returns the messages, headers and arrival times that were recorded."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Message
from beamsplat.common.messages.codec import decode
from beamsplat.common.messages.header import DecodeError, Header
from beamsplat.common.recording import layout, ros_types
from beamsplat.common.recording.damage import describe_damage
from beamsplat.common.recording.from_ros import fields_of
from beamsplat.common.recording.mcap_file import MAGIC, Channel, McapFile
from beamsplat.common.recording.mcap_file import Message as McapMessage

_READ_ROLES = ("message", "fields", "own")


class RecordedMessage(NamedTuple):
    """A message in a recording, with its topic, arrival time and header."""

    log_time_ns: int  # arrival time at the recorder
    topic: str
    message: Message
    header: Header | None  # None if it was recorded without one


def mcap_files(path: Path) -> list[Path]:
    """Return the MCAP files of a recording: `path` itself, or the files in this folder sorted by name."""
    path = Path(path)
    return sorted(path.glob("*.mcap")) if path.is_dir() else [path]


def is_recording(path: Path) -> bool:
    """Return whether a file or folder is a BeamSplat recording, by the first bytes of its MCAP file."""
    for file in mcap_files(path):
        if file.is_file():
            with file.open("rb") as stream:
                head = stream.read(256)
            return head.startswith(MAGIC) and layout.LIBRARY.split()[0].encode() in head
    return False


class RecordingReader:
    """An open recording; truncated and damaged files are read as far as possible (see `problems`).

    Raises:
        UserError: there is no MCAP file, or it is not a BeamSplat recording.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.undecodable: Counter[str] = Counter()  # skipped messages by topic
        paths = [file for file in mcap_files(self.path) if file.is_file()]
        if not paths:
            raise UserError(f"{self.path}: no such recording (no MCAP file found)")
        self.files: list[McapFile] = []
        try:
            for file in paths:
                self.files.append(McapFile(file))
                if not self.files[-1].library.startswith(layout.LIBRARY.split()[0]):
                    raise UserError(f"{file}: an MCAP file, but not a BeamSplat recording")
        except UserError:
            self.close()
            raise

    @property
    def problems(self) -> list[str]:
        """Sentences about missing and damaged data that the reader has found so far."""
        found = [f"{file.path}: {file.truncated}" for file in self.files if file.truncated]
        damaged = [span for file in self.files for span in file.damaged.values()]
        if damaged:
            found.append(describe_damage(self.path, damaged, self.start_ns, self.end_ns))
        found += [f"{topic}: {count} messages do not decode" for topic, count in self.undecodable.items()]
        return found

    @property
    def counts(self) -> Counter[str]:
        """Number of messages in the recording, by topic."""
        counts: Counter[str] = Counter()
        for file in self.files:
            for channel_id, count in file.counts.items():
                metadata = file.channels[channel_id].metadata
                if metadata.get(layout.ROLE) in ("message", "own"):
                    counts[metadata[layout.TOPIC]] += count
        return counts

    @property
    def start_ns(self) -> int:
        """Arrival time of the first message at the recorder, in nanoseconds."""
        return min((file.start_ns for file in self.files if file.counts), default=0)

    @property
    def end_ns(self) -> int:
        """Arrival time of the last message at the recorder, in nanoseconds."""
        return max((file.end_ns for file in self.files), default=0)

    def messages(
        self, topics: Collection[str] | None = None, start_ns: int = 0, stop_ns: int | None = None
    ) -> Iterator[RecordedMessage]:
        """Yield messages with start_ns <= arrival time < stop_ns in order of arrival.

        Messages that do not decode are skipped and counted in `undecodable`. `topics` None = all.
        """
        streams = [self._file_messages(file, topics, start_ns, stop_ns) for file in self.files]
        yield from heapq.merge(*streams, key=lambda recorded: recorded.log_time_ns)

    def _file_messages(
        self, file: McapFile, topics: Collection[str] | None, start_ns: int, stop_ns: int | None
    ) -> Iterator[RecordedMessage]:
        ids = {
            channel_id
            for channel_id, channel in file.channels.items()
            if channel.metadata.get(layout.ROLE) in _READ_ROLES
            and (topics is None or channel.metadata.get(layout.TOPIC) in topics)
        }
        extra_fields: dict[tuple[Any, ...], bytes] = {}  # "fields" records; their ROS message follows
        for channel, message in file.messages(ids, start_ns, stop_ns):
            role, topic = channel.metadata[layout.ROLE], channel.metadata[layout.TOPIC]
            key = (topic, message.log_time, message.sequence, channel.metadata.get("beamsplat.instance"))
            if role == "fields":
                extra_fields[key] = message.data
                continue
            try:
                decoded = _decode(file, channel, message, extra_fields.pop(key, None))
                header = layout.header_of(
                    channel.metadata, decoded.stamp_ns, message.publish_time, message.sequence
                )
            except DecodeError:
                self.undecodable[topic] += 1
                continue
            yield RecordedMessage(message.log_time, topic, decoded, header)

    def close(self) -> None:
        for file in self.files:
            file.close()

    def __enter__(self) -> RecordingReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _decode(file: McapFile, channel: Channel, message: McapMessage, extra_fields: bytes | None) -> Message:
    schema = channel.metadata.get(layout.SCHEMA, "")
    if channel.metadata[layout.ROLE] == "own":
        return decode(schema, message.data)
    cls = layout.class_of(schema)
    rest = layout.unpack_fields(extra_fields, cls) if extra_fields is not None else {}
    try:
        ros_message = ros_types.deserialize(message.data, file.schemas[channel.schema_id].name)
        return cls.model_validate(_carried(cls, ros_message) | rest)
    except (ValueError, KeyError) as error:
        raise DecodeError(f"{schema}: {error}") from error


def _carried(cls: type[Message], ros_message: Any) -> dict[str, Any]:
    try:
        return fields_of(cls, ros_message)
    except ValueError:  # nothing in the ROS message can be used: all fields are in the "fields" record
        return {}
