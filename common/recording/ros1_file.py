"""Reader of ROS 1 bags, format 2.0 and 1.2: by the index of a complete file, else record by record.

The reader of the `rosbags` package needs every record of the index to be right. This reader takes from the
index only where the chunks are, and reads the messages from the chunks themselves; so it also reads files
whose index is wrong or missing (a recorder that crashed leaves NAME.bag.active), and skips damaged chunks.

Format: wiki.ros.org/Bags/Format/2.0 and /1.2.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

from beamsplat.common.errors import UserError
from beamsplat.common.recording.decompression import MAX_BLOCK_BYTES, decompress

_MAGIC_20, _MAGIC_12 = b"#ROSBAG V2.0\n", b"#ROSRECORD V1.2\n"
_MESSAGE, _HEADER, _CHUNK, _CHUNK_INFO, _CONNECTION = b"\2", b"\3", b"\5", b"\6", b"\7"
_MAX_HEADER_BYTES = 1_000_000  # of a record; usual ones have 100 bytes
_REGION_BYTES = 4 * 1024 * 1024  # of consecutive messages outside chunks that are read at once
_MAX_HELD_BYTES = 8 * MAX_BLOCK_BYTES
_DAMAGE = (ValueError, struct.error, KeyError, IndexError, UnicodeDecodeError, MemoryError, OverflowError)


class Ros1Connection(NamedTuple):
    """A topic of a bag and its type, of the form pkg/Type."""

    topic: str
    type_name: str
    md5: str


class Ros1Message(NamedTuple):
    """A serialised message, with the number of its connection and its receive time."""

    connection: int
    at_ns: int
    data: bytes


@dataclass
class _Block:
    """A chunk, or consecutive records outside chunks (`chunked` = False)."""

    offset: int
    length: int
    start_ns: int
    end_ns: int
    connections: set[int]
    chunked: bool = True


@dataclass
class Ros1File:
    """An open ROS 1 bag with its index.

    Raises:
        UserError: the file is not a ROS 1 bag, or of a format that is not read.
    """

    path: Path
    version: str = ""  # "2.0" or "1.2"
    truncated: str = ""  # what is missing, as a sentence; "" = the file is complete
    connections: dict[int, Ros1Connection] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)  # messages by connection
    start_ns: int = 0
    end_ns: int = 0
    damaged: dict[int, tuple[int, int]] = field(default_factory=dict)  # receive times of blocks, by offset

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        self._blocks: list[_Block] = []
        self._numbers: dict[Ros1Connection, int] = {}  # format 1.2 has no numbers
        self._size = self.path.stat().st_size
        self._file: BinaryIO = self.path.open("rb")
        try:
            self._open()
        except UserError:
            self._file.close()
            raise

    def close(self) -> None:
        self._file.close()

    def messages(self, connections: Collection[int], start_ns: int, stop_ns: int) -> Iterator[Ros1Message]:
        """Yield messages with start_ns <= at_ns < stop_ns by receive time; equal times are in file order.

        A block that cannot be decoded is skipped, and its receive times are stored in `damaged`.

        Raises:
            UserError: blocks overlap in time so much that more than 1 GiB of messages must be held back.
        """
        wanted = set(connections)
        heap: list[tuple[int, int, int, Ros1Message]] = []
        held_bytes = 0
        for number, block in enumerate(self._blocks):
            while heap and heap[0][0] < block.start_ns:
                message = heapq.heappop(heap)[3]
                held_bytes -= len(message.data)
                yield message
            if block.end_ns < start_ns or block.start_ns >= stop_ns or wanted.isdisjoint(block.connections):
                continue
            for position, message in enumerate(self._read_block(block)):
                if message.connection in wanted and start_ns <= message.at_ns < stop_ns:
                    heapq.heappush(heap, (message.at_ns, number, position, message))
                    held_bytes += len(message.data)
            if held_bytes > _MAX_HELD_BYTES:
                raise UserError(
                    f"{self.path}: its messages are too far out of order: more than "
                    f"{_MAX_HELD_BYTES >> 20} MiB would have to be held back; sort the bag, for example "
                    "with `rosbag sort`"
                )
        while heap:
            yield heapq.heappop(heap)[3]

    def _open(self) -> None:
        line = self._file.read(40).split(b"\n")[0] + b"\n"
        if line not in (_MAGIC_20, _MAGIC_12):
            if line.startswith((b"#ROSBAG", b"#ROSRECORD")):
                name = line.decode(errors="replace").strip()
                raise UserError(
                    f"{self.path}: bag format {name!r} is not read (only 2.0 and 1.2); convert it with "
                    f"ROS 1: `rosbag filter {self.path.name} new.bag True`"
                )
            raise UserError(f"{self.path}: not a bag, in spite of its name (its first bytes are wrong)")
        self.version = "2.0" if line == _MAGIC_20 else "1.2"
        if self.version == "1.2" or not self._read_index(len(line)):
            self._scan(len(line))
        self._blocks.sort(key=lambda block: (block.start_ns, block.offset))
        self.start_ns = min((block.start_ns for block in self._blocks), default=0)
        self.end_ns = max((block.end_ns for block in self._blocks), default=0)

    def _read_index(self, position: int) -> bool:
        """Read connections and chunk infos at the end of the file; return False if they are not all there."""
        try:
            fields, _, _ = self._record(position)
            if fields.get(b"encryptor"):
                raise UserError(
                    f"{self.path}: the bag is encrypted: decrypt it with ROS 1 (`rosbag decrypt`)"
                )
            (index,) = struct.unpack("<Q", fields[b"index_pos"])
            connections, chunks = (struct.unpack("<I", fields[n])[0] for n in (b"conn_count", b"chunk_count"))
            if not position < index <= self._size or (chunks and not connections):
                return False
            while index < self._size:
                fields, data, index = self._record(index)
                if fields[b"op"] == _CONNECTION:
                    self._take_connection(fields, data)
                elif fields[b"op"] == _CHUNK_INFO:
                    self._take_chunk_info(fields, data)
        except _DAMAGE:
            self._forget()
            return False
        offsets = sorted(block.offset for block in self._blocks)
        whole = len(self._blocks) == chunks and len(set(offsets)) == chunks
        if not whole or (offsets and offsets[0] < position):
            self._forget()
            return False
        return True

    def _forget(self) -> None:
        self._blocks.clear()
        self.connections.clear()
        self.counts.clear()

    def _record(self, position: int) -> tuple[dict[bytes, bytes], bytes, int]:
        """Return (fields of the header, data, position of the next record); raises ValueError on damage."""
        fields, start, length = self._record_head(position)
        if length > MAX_BLOCK_BYTES:
            raise ValueError(f"record of {length} bytes")
        self._file.seek(start)
        return fields, self._file.read(length), start + length

    def _record_head(self, position: int) -> tuple[dict[bytes, bytes], int, int]:
        """Return (fields of the header, position of the data, length of the data) of the record there."""
        self._file.seek(position)
        head = self._file.read(4)
        (length,) = struct.unpack("<I", head)
        if length > _MAX_HEADER_BYTES:
            raise ValueError(f"record header of {length} bytes")
        header = self._file.read(length + 4)
        if len(header) != length + 4:
            raise ValueError("the file ends within a record")
        (data_bytes,) = struct.unpack("<I", header[length:])
        start = position + 8 + length
        if start + data_bytes > self._size:
            raise ValueError("the file ends within a record")
        return _fields(header[:length]), start, data_bytes

    def _take_connection(self, fields: dict[bytes, bytes], data: bytes) -> int:
        inner = _fields(data)
        (number,) = struct.unpack("<I", fields[b"conn"])
        topic = fields[b"topic"].decode()
        self.connections[number] = Ros1Connection(
            _normalized(topic), inner[b"type"].decode(), inner.get(b"md5sum", b"*").decode()
        )
        return number

    def _take_chunk_info(self, fields: dict[bytes, bytes], data: bytes) -> None:
        (offset,) = struct.unpack("<Q", fields[b"chunk_pos"])
        ids: list[int] = []
        counts: Counter[int] = Counter()
        for i in range(len(data) // 8):
            number, count = struct.unpack_from("<II", data, 8 * i)
            ids.append(number)
            counts[number] += count
        if offset >= self._size:
            raise ValueError("chunk beyond the end of the file")
        self.counts.update(counts)
        self._blocks.append(
            _Block(offset, 0, _time_ns(fields[b"start_time"]), _time_ns(fields[b"end_time"]), set(ids))
        )

    def _scan(self, position: int) -> None:
        """Build the index by reading all records; set `truncated` if the file is incomplete."""
        closed = self.version == "1.2"
        while position < self._size:
            try:
                fields, start, length = self._record_head(position)
                op = fields[b"op"]
                if op == _MESSAGE:  # in format 2.0: of a chunk that was not closed
                    self._scan_message(fields, position, start + length - position)
            except _DAMAGE:
                self.truncated = (
                    f"readable up to byte {position} of {self._size}: all messages after it are lost"
                )
                return
            end = start + length
            if op == _CHUNK:
                self._scan_chunk(position, end - position)
            elif op == _CONNECTION:
                self._file.seek(start)
                self._take_connection(fields, self._file.read(length))
            closed = closed or op == _CHUNK_INFO
            position = end
        if not closed:
            self.truncated = (
                "the recorder has not closed it: its index is missing, all complete chunks are read"
            )

    def _scan_chunk(self, offset: int, length: int) -> None:
        block = _Block(offset, length, 2**63 - 1, 0, set())
        for message in self._read_block(block):
            block.connections.add(message.connection)
            block.start_ns, block.end_ns = (
                min(block.start_ns, message.at_ns),
                max(block.end_ns, message.at_ns),
            )
            self.counts[message.connection] += 1
        if block.connections:
            self._blocks.append(block)
        elif offset in self.damaged:  # its times are between those of its neighbours
            before = max((other.end_ns for other in self._blocks), default=0)
            self.damaged[offset] = (before, before)

    def _scan_message(self, fields: dict[bytes, bytes], position: int, length: int) -> None:
        number, at_ns = self._address(fields)
        self.counts[number] += 1
        last = self._blocks[-1] if self._blocks else None
        if last and last.length < _REGION_BYTES and last.offset + last.length == position:
            last.length += length
            last.start_ns, last.end_ns = min(last.start_ns, at_ns), max(last.end_ns, at_ns)
            last.connections.add(number)
        else:
            self._blocks.append(_Block(position, length, at_ns, at_ns, {number}, chunked=False))

    def _address(self, fields: dict[bytes, bytes]) -> tuple[int, int]:
        """Return (connection, receive time ns) of a message by the header of its record."""
        if self.version == "2.0":
            (number,) = struct.unpack("<I", fields[b"conn"])
            if number not in self.connections:
                raise ValueError("message of a connection that is not declared")
            return number, _time_ns(fields[b"time"])
        connection = Ros1Connection(
            _normalized(fields[b"topic"].decode()), fields[b"type"].decode(), fields[b"md5"].decode()
        )
        number = self._numbers.setdefault(connection, len(self._numbers))
        self.connections[number] = connection
        return number, _time_ns(fields[b"sec"] + fields[b"nsec"])

    def _read_block(self, block: _Block) -> list[Ros1Message]:
        """Return the messages of a block in file order; if it cannot be decoded, store it as damaged."""
        try:
            if not block.chunked:
                self._file.seek(block.offset)
                return list(self._parse(self._file.read(block.length)))
            fields, data, _ = self._record(block.offset)
            if fields[b"op"] != _CHUNK:
                raise ValueError("not a chunk")
            compression, size = fields[b"compression"].decode(), struct.unpack("<I", fields[b"size"])[0]
            if compression != "none":
                data = decompress(data, compression, min(size, MAX_BLOCK_BYTES))
            if len(data) != size:
                raise ValueError(f"chunk of {len(data)} bytes, stated are {size}")
            return list(self._parse(data))
        except _DAMAGE:
            self.damaged[block.offset] = (block.start_ns, block.end_ns)
            return []

    def _parse(self, data: bytes) -> Iterator[Ros1Message]:
        position = 0
        while position < len(data):
            (length,) = struct.unpack_from("<I", data, position)
            fields = _fields(data[position + 4 : position + 4 + length])
            position += 4 + length
            (size,) = struct.unpack_from("<I", data, position)
            body = data[position + 4 : position + 4 + size]
            if len(body) != size:
                raise ValueError("a message ends outside of its chunk")
            position += 4 + size
            if fields[b"op"] == _MESSAGE:
                yield Ros1Message(*self._address(fields), body)
            elif fields[b"op"] == _CONNECTION:
                self._take_connection(fields, body)


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Return the fields NAME=VALUE of a record header."""
    found: dict[bytes, bytes] = {}
    position = 0
    while position < len(header):
        (length,) = struct.unpack_from("<I", header, position)
        entry = header[position + 4 : position + 4 + length]
        name, equals, value = entry.partition(b"=")
        if len(entry) != length or not equals:
            raise ValueError("a field of a record header is damaged")
        found[name] = value
        position += 4 + length
    return found


def _time_ns(value: bytes) -> int:
    sec, nanosec = struct.unpack("<II", value)
    return sec * 10**9 + nanosec


def _normalized(topic: str) -> str:
    """Return the name of a topic with one leading slash; old recorders wrote it without."""
    return "/" + "/".join(part for part in topic.split("/") if part)
