"""Writer of recordings: MCAP files for Foxglove and `ros2 bag`. A crash loses at most the last chunk."""

from __future__ import annotations

import contextlib
import errno
import os
from collections import Counter
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.writer import CompressionType, Writer

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Message
from beamsplat.common.messages.codec import encode, schema_of
from beamsplat.common.messages.header import Header
from beamsplat.common.recording import layout, ros_types
from beamsplat.common.recording.from_ros import fields_of
from beamsplat.common.recording.grid_records import GridRecords
from beamsplat.common.recording.metadata import metadata_yaml, qos_profiles
from beamsplat.common.recording.to_ros import RosRecord, records_of


class RecordingError(OSError):
    """The recording has stopped, usually because the disk is full. The written part stays readable."""


class _File:
    """Unbuffered output file; `chunk_end` is the end of the last complete chunk.

    `mcap.Writer` writes each record with one call, so a chunk is passed to the operating system when it ends,
    and kill -9 loses only the chunk in memory.
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self.position = 0
        self.chunk_end = 0

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        while view:
            written = os.write(self._fd, view)
            self.position += written
            view = view[written:]
        return len(data)

    def tell(self) -> int:
        return self.position

    def flush(self) -> None:
        self.chunk_end = self.position

    def sync(self) -> None:
        os.fdatasync(self._fd)

    def truncate_to_chunk_end(self) -> None:
        os.ftruncate(self._fd, self.chunk_end)

    def close(self) -> None:
        os.close(self._fd)


class RecordingWriter:
    """Writer of one recording, usable as a context manager; messages may be of any topics in any order.

    Args:
        path: folder to create (a ROS 2 bag with NAME_0.mcap and metadata.yaml), or a file ending in .mcap.
        chunk_bytes: size at which an MCAP chunk ends; a crash loses at most one chunk.
        chunk_s: duration after which a chunk ends, by arrival time (s).
        compression: compression method of the chunks.
        sync: call fdatasync after each chunk, against power loss.
        overwrite: replace an existing recording.

    Raises:
        UserError: the path exists (without `overwrite`) or cannot be created.
        OSError: the disk is full or broken; nothing is left behind.
    """

    def __init__(
        self,
        path: Path,
        *,
        chunk_bytes: int = 1024 * 1024,
        chunk_s: float = 1.0,
        compression: CompressionType = CompressionType.ZSTD,
        sync: bool = False,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        self.counts: Counter[str] = Counter()  # written messages by topic
        self.lost: Counter[str] = Counter()  # messages that were not written to disk, by topic
        self._sync = sync
        self._chunk_ns = round(chunk_s * 1e9)
        self._chunk_bytes = chunk_bytes
        self._bytes = 0
        self._chunk_start_ns: int | None = None
        self._in_chunk: Counter[str] = Counter()
        self._channels: dict[tuple[Any, ...], int] = {}
        self._schemas: dict[str, int] = {}
        self._sequences: Counter[str] = Counter()
        self._grid = GridRecords()
        self._ros_topics: dict[str, tuple[str, int]] = {}  # ROS topic -> (type, count), for metadata.yaml
        self._times_ns: list[int] = []  # first and last log time
        self._failure = ""
        self._closed = False
        self.file_path = self._make_path(overwrite)
        self._file = _File(self.file_path)
        # Chunks end in `flush` only, between two messages, so that a message and its fields are in one chunk.
        self._writer = Writer(
            self._file,  # type: ignore[arg-type]  # of IO, the writer calls these three methods only
            chunk_size=2**62,
            compression=compression,
        )
        try:
            self._writer.start(layout.PROFILE, layout.LIBRARY)
        except OSError:
            self._file.close()
            self.remove_files()
            raise

    def remove_files(self) -> None:
        """Remove the files of a closed recording, for example of one that has no message."""
        with contextlib.suppress(OSError):
            self.file_path.unlink(missing_ok=True)
            if self.file_path != self.path:
                (self.path / "metadata.yaml").unlink(missing_ok=True)
                self.path.rmdir()

    def write(self, topic: str, message: Message, log_time_ns: int, header: Header | None = None) -> None:
        """Append one message; `log_time_ns` is its arrival time (ns) at the recorder.

        Raises:
            RecordingError: writing failed; this message and all later ones are counted in `lost`.
        """
        if self._failure or self._closed:
            self.lost[topic] += 1
            raise RecordingError(self._failure or f"{self.file_path}: recording is closed")
        sequence = self._sequences[topic] if header is None else header.sequence
        self._sequences[topic] += 1
        try:
            self._in_chunk[topic] += 1
            self._write_records(topic, message, log_time_ns, header, sequence)
            if self._chunk_start_ns is None:
                self._chunk_start_ns = log_time_ns
            age_ns = log_time_ns - self._chunk_start_ns
            if age_ns >= self._chunk_ns or self._bytes >= self._chunk_bytes:
                self.flush()
        except OSError as error:
            raise self._fail(error) from error

    def flush(self) -> None:
        """Write the current chunk to the file: a later crash of this process loses no message before it."""
        try:
            self._writer.flush()
            if self._sync:
                self._file.sync()
        except OSError as error:
            raise self._fail(error) from error
        self._chunk_start_ns, self._bytes = None, 0
        self.counts.update(self._in_chunk)
        self._in_chunk.clear()

    def close(self) -> None:
        """Complete the recording: write the index and metadata.yaml. Further calls do nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            if not self._failure:
                self.flush()
                self._writer.finish()
                if self._sync:
                    self._file.sync()
                if self.file_path != self.path:
                    self._write_metadata()
        except RecordingError:
            raise
        except OSError as error:
            raise self._fail(error) from error
        finally:
            self._file.close()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _make_path(self, overwrite: bool) -> Path:
        single = self.path.suffix == ".mcap"
        file = self.path if single else self.path / f"{self.path.name}_0.mcap"
        if self.path.exists() and not overwrite:
            raise UserError(f"{self.path}: exists already and is not overwritten: choose another name")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            if overwrite:  # remove the files of a recording of this name only
                file.unlink(missing_ok=True)
                if not single:
                    (self.path / "metadata.yaml").unlink(missing_ok=True)
        except OSError as error:
            raise UserError(f"{self.path}: cannot be created: {error.strerror}") from error
        return file

    def _write_records(
        self, topic: str, message: Message, log_time_ns: int, header: Header | None, sequence: int
    ) -> None:
        # The fields are written first, so that a reader has them when it reads the ROS message.
        records = records_of(topic, message)
        carried = next((record for record in records if record.role == "message"), None)
        when = (log_time_ns, log_time_ns if header is None else header.publish_ns, sequence % 2**32)
        if carried is None:
            channel = self._own_channel(topic, message, "own", layout.OWN_ENCODING, header)
            self._add(channel, encode(message), *when)
        else:
            cdr = ros_types.serialize(carried.message)
            missing = layout.missing_fields(
                message, _carried_fields(message, cdr, carried.message.__msgtype__)
            )
            if missing:
                channel = self._own_channel(topic, message, "fields", layout.FIELDS_ENCODING, header)
                self._add(channel, layout.pack_fields(missing), *when)
            self._add_ros(topic, message, carried, cdr, header, when)
        for record in [*records, *self._grid.records_of(message)]:
            if record is not carried:
                cdr = ros_types.serialize(record.message)
                self._add_ros(topic, message, record, cdr, header, when)

    def _add(self, channel: int, data: bytes, log_time_ns: int, publish_ns: int, sequence: int) -> None:
        self._writer.add_message(channel, log_time_ns, data, publish_ns, sequence)
        self._bytes += len(data)
        first, last = self._times_ns or (log_time_ns, log_time_ns)
        self._times_ns = [min(first, log_time_ns), max(last, log_time_ns)]

    def _add_ros(
        self,
        topic: str,
        message: Message,
        record: RosRecord,
        cdr: bytes,
        header: Header | None,
        when: tuple[int, int, int],
    ) -> None:
        type_name = record.message.__msgtype__
        metadata = {
            layout.ROLE: record.role, layout.TOPIC: topic, layout.SCHEMA: schema_of(message),
            **layout.sender_metadata(header), "offered_qos_profiles": qos_profiles(record.topic),
        }  # fmt: skip
        schema = self._schema(type_name, "ros2msg", ros_types.definition(type_name))
        self._add(self._channel(record.topic, "cdr", schema, metadata), cdr, *when)
        count = self._ros_topics.get(record.topic, (type_name, 0))[1]
        self._ros_topics[record.topic] = (type_name, count + 1)

    def _own_channel(
        self, topic: str, message: Message, role: str, encoding: str, header: Header | None
    ) -> int:
        name = f"{layout.OWN_PREFIX}{topic}" + ("/fields" if role == "fields" else "")
        metadata = {
            layout.ROLE: role, layout.TOPIC: topic, layout.SCHEMA: schema_of(message),
            layout.JSON_SCHEMA: layout.json_schema(type(message)), **layout.sender_metadata(header),
        }  # fmt: skip
        return self._channel(name, encoding, layout.NO_SCHEMA, metadata)

    def _channel(self, name: str, encoding: str, schema_id: int, metadata: dict[str, str]) -> int:
        key = (name, encoding, schema_id, *sorted(metadata.items()))
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(name, encoding, schema_id, metadata)
        return self._channels[key]

    def _schema(self, name: str, encoding: str, data: bytes) -> int:
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, encoding, data)
        return self._schemas[name]

    def _fail(self, error: OSError) -> RecordingError:
        """Stop the recording: truncate the file to its last complete chunk, and return the error to raise."""
        if isinstance(error, RecordingError):
            return error
        reason = (
            "the disk is full"
            if error.errno in (errno.ENOSPC, errno.EDQUOT)
            else str(error.strerror or error)
        )
        self.lost.update(self._in_chunk)
        self._in_chunk.clear()
        self._failure = (
            f"{self.file_path}: recording stopped because {reason}; "
            f"{self.counts.total()} messages are saved, {self.lost.total()} were lost"
        )
        with contextlib.suppress(OSError):  # a reader finds the end of the last complete chunk itself
            self._file.truncate_to_chunk_end()
        return RecordingError(self._failure)

    def _write_metadata(self) -> None:
        text = metadata_yaml(self.file_path.name, self._ros_topics, *(self._times_ns or [0, 0]))
        partial = self.path / "metadata.yaml.partial"
        partial.write_text(text)
        os.replace(partial, self.path / "metadata.yaml")


def _carried_fields(message: Message, cdr: bytes, type_name: str) -> dict[str, Any]:
    """Return the fields of `message` that `RecordingReader` can restore from its ROS message alone, by name.

    Args:
        message: the BeamSplat message to be recorded.
        cdr: the ROS message to which it was converted, as serialised (CDR) bytes.
        type_name: type of the ROS message, for example "sensor_msgs/msg/LaserScan".

    Returns:
        The fields after a round trip through `cdr`: values can differ from those of `message`. An empty
        dict if the ROS message cannot be read back.
    """
    try:
        return fields_of(type(message), ros_types.deserialize(cdr, type_name))
    except ValueError:  # the ROS message cannot be read back: all fields are stored in the "fields" record
        return {}
