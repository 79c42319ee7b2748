"""Reader of MCAP files: uses the index of complete files and scans truncated files chunk by chunk.

The reader of the `mcap` package rejects files without a footer, for example from a robot that lost power.
This reader indexes the complete chunks of a truncated file and reports the missing parts.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Footer, Header, Message, Schema, Statistics

from beamsplat.common.errors import UserError
from beamsplat.common.recording.decompression import MAX_BLOCK_BYTES, decompress

MAGIC = b"\x89MCAP0\r\n"
_FOOTER_BYTES = 9 + 20 + len(MAGIC)
_PREFIX = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
# Maximum size of a block of messages outside chunks: limits the memory of one read.
_REGION_BYTES = 4 * 1024 * 1024
# Maximum size of the messages that are held back because chunks overlap in time.
_MAX_HELD_BYTES = 8 * MAX_BLOCK_BYTES
# Exceptions that record parsers and decompressors raise on damaged bytes.
_DAMAGE: tuple[type[Exception], ...] = (
    McapError, ValueError, struct.error, RuntimeError, EOFError, OverflowError, MemoryError,
)  # fmt: skip


@dataclass
class _Block:
    """A chunk, or consecutive messages outside chunks in a file written without chunks."""

    offset: int
    length: int
    start_ns: int
    end_ns: int
    channel_ids: set[int] | None  # None = unknown until the block is read
    chunked: bool = True


@dataclass
class McapFile:
    """An open MCAP file with its index.

    Raises:
        UserError: the file is not an MCAP file, or nothing in it can be read.
    """

    path: Path
    profile: str = ""
    library: str = ""
    truncated: str = ""  # what is missing of a truncated file, as a sentence; "" = the file is complete
    damaged: dict[int, tuple[int, int]] = field(default_factory=dict)  # log times of chunks, by offset
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)  # messages by channel id
    start_ns: int = 0  # first log time
    end_ns: int = 0  # last log time

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        self._blocks: list[_Block] = []
        self._size = self.path.stat().st_size
        self._file: BinaryIO = self.path.open("rb")
        try:
            self._open()
        except _DAMAGE as error:
            self._file.close()
            raise UserError(
                f"{self.path}: damaged MCAP file: {str(error) or type(error).__name__}"
            ) from error
        except UserError:
            self._file.close()
            raise

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> McapFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def messages(
        self, channel_ids: Collection[int] | None = None, start_ns: int = 0, stop_ns: int | None = None
    ) -> Iterator[tuple[Channel, Message]]:
        """Yield messages with start_ns <= log_time < stop_ns in order of log time, equal times in file order.

        Chunks without any of the channels are not read. A chunk that cannot be decoded is skipped and counted
        in `damaged`.

        Raises:
            UserError: chunks overlap in time so much that more than 1 GiB of messages must be held back.
        """
        wanted = None if channel_ids is None else set(channel_ids)
        stop_ns = 2**64 if stop_ns is None else stop_ns
        heap: list[tuple[int, int, int, Message]] = []
        held_bytes = 0
        for number, block in enumerate(self._blocks):
            while heap and heap[0][0] < block.start_ns:
                message = heapq.heappop(heap)[3]
                held_bytes -= len(message.data)
                yield self.channels[message.channel_id], message
            if block.end_ns < start_ns or block.start_ns >= stop_ns:
                continue
            if wanted is not None and block.channel_ids is not None and wanted.isdisjoint(block.channel_ids):
                continue
            for position, message in enumerate(self._read_block(block)):
                if (
                    wanted is None or message.channel_id in wanted
                ) and start_ns <= message.log_time < stop_ns:
                    heapq.heappush(heap, (message.log_time, number, position, message))
                    held_bytes += len(message.data)
            if held_bytes > _MAX_HELD_BYTES:
                raise UserError(
                    f"{self.path}: its messages are too far out of order: more than "
                    f"{_MAX_HELD_BYTES >> 20} MiB would have to be held back; sort the file, for example "
                    "with `mcap sort`"
                )
        while heap:
            message = heapq.heappop(heap)[3]
            yield self.channels[message.channel_id], message

    def _open(self) -> None:
        if self._file.read(len(MAGIC)) != MAGIC:
            raise UserError(f"{self.path}: not an MCAP file (wrong first bytes)")
        if not self._read_summary():
            self._scan()
        self._blocks.sort(key=lambda block: (block.start_ns, block.offset))
        self.start_ns = min((block.start_ns for block in self._blocks), default=0)
        self.end_ns = max((block.end_ns for block in self._blocks), default=0)

    def _read_summary(self) -> bool:
        """Read the index at the end of the file; return False if it is missing, damaged or incomplete."""
        self._file.seek(len(MAGIC))
        self._take_header(self._file.read(min(self._size, 4096)))
        if self._size < len(MAGIC) + _FOOTER_BYTES:
            return False
        self._file.seek(self._size - _FOOTER_BYTES)
        tail = self._file.read(_FOOTER_BYTES)
        if tail[0] != Opcode.FOOTER or tail[-len(MAGIC) :] != MAGIC:
            return False
        footer = Footer.read(_stream(tail[9:-8]))
        if not len(MAGIC) <= footer.summary_start < self._size - _FOOTER_BYTES:
            return False
        if self._size - footer.summary_start > MAX_BLOCK_BYTES:
            return False
        self._file.seek(footer.summary_start)
        summary = self._file.read(self._size - _FOOTER_BYTES - footer.summary_start)
        # The checksum covers the summary section and the footer up to the checksum field.
        if footer.summary_crc and zlib.crc32(tail[:25], zlib.crc32(summary)) != footer.summary_crc:
            return False
        counted = False
        for opcode, body in _records(summary):
            if opcode == Opcode.CHUNK_INDEX:
                index = ChunkIndex.read(_stream(body))
                # A chunk without message indexes can hold any channel: None, because {} means no channel.
                ids = set(index.message_index_offsets) or None
                self._blocks.append(
                    _Block(
                        index.chunk_start_offset, index.chunk_length,
                        index.message_start_time, index.message_end_time, ids,
                    )
                )  # fmt: skip
            elif opcode == Opcode.STATISTICS:
                self.counts.update(Statistics.read(_stream(body)).channel_message_counts)
                counted = True
            else:
                self._take_definition(opcode, body)
        complete = counted and bool(self.channels) and (bool(self._blocks) or not self.counts.total())
        if not complete:
            self._blocks.clear()
            self.counts.clear()
        return complete

    def _take_header(self, data: bytes) -> None:
        for opcode, body in _records(data):
            if opcode == Opcode.HEADER:
                header = Header.read(_stream(body))
                self.profile, self.library = header.profile, header.library
            return

    def _take_definition(self, opcode: int, body: bytes | memoryview) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(_stream(body))
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(_stream(body))
            self.channels[channel.id] = channel

    def _scan(self) -> None:
        """Build the index by reading all records; set `truncated` if the file is incomplete."""
        position = len(MAGIC)
        while True:
            self._file.seek(position)
            prefix = self._file.read(_PREFIX.size)
            if len(prefix) < _PREFIX.size:
                break
            opcode, length = _PREFIX.unpack(prefix)
            end = position + _PREFIX.size + length
            if end > self._size or not 0 < opcode <= Opcode.DATA_END:
                break
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                self._file.seek(self._size - len(MAGIC))
                if self._file.read() != MAGIC:
                    self.truncated = "its last bytes (the index) are missing, but it has all messages"
                return
            self._scan_record(opcode, position, length)
            position = end
        self.truncated = self._describe_loss(position)

    def _scan_record(self, opcode: int, position: int, length: int) -> None:
        whole = _PREFIX.size + length
        if opcode == Opcode.CHUNK:
            start_ns, end_ns = _CHUNK_HEAD.unpack(self._file.read(_CHUNK_HEAD.size))[:2]
            channel_ids: set[int] = set()
            block = _Block(position, whole, start_ns, end_ns, channel_ids)
            for message in self._read_block(block):
                channel_ids.add(message.channel_id)
                self.counts[message.channel_id] += 1
            self._blocks.append(block)
        elif opcode == Opcode.MESSAGE:
            channel_id, _, log_time, _ = _MESSAGE_HEAD.unpack(self._file.read(_MESSAGE_HEAD.size))
            self.counts[channel_id] += 1
            last = self._blocks[-1] if self._blocks else None
            if (
                last
                and not last.chunked
                and last.length < _REGION_BYTES
                and last.offset + last.length == position
            ):
                last.length += whole
                last.start_ns, last.end_ns = min(last.start_ns, log_time), max(last.end_ns, log_time)
                assert last.channel_ids is not None  # known for messages outside chunks
                last.channel_ids.add(channel_id)
            else:
                self._blocks.append(_Block(position, whole, log_time, log_time, {channel_id}, chunked=False))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._take_definition(opcode, self._file.read(length))

    def _describe_loss(self, position: int) -> str:
        lost = self._size - position
        text = f"truncated: readable up to byte {position} of {self._size}: "
        if lost == 0:
            return text + "the end of the file with its index is missing, all complete chunks are readable"
        self._file.seek(position)
        head = self._file.read(_PREFIX.size + _CHUNK_HEAD.size)
        if len(head) == _PREFIX.size + _CHUNK_HEAD.size and head[0] == Opcode.CHUNK:
            start_ns, end_ns, size, _ = _CHUNK_HEAD.unpack(head[_PREFIX.size :])
            if start_ns <= end_ns < 2**63 and size < 2**40:
                return text + (
                    f"the last chunk ({(end_ns - start_ns) / 1e9:.2f} s, {size} bytes of messages) and all "
                    "messages after it are lost"
                )
        return text + f"the last {lost} bytes of the file and all messages after them are lost"

    def _read_block(self, block: _Block) -> list[Message]:
        """Return the messages of a block in file order; if it cannot be decoded, count it and return []."""
        try:
            if block.offset + block.length > self._size:
                raise McapError("chunk beyond the end of the file")
            if block.length > MAX_BLOCK_BYTES:
                raise McapError(f"chunk of {block.length} bytes")
            self._file.seek(block.offset)
            data = self._file.read(block.length)
            if block.chunked:
                chunk = Chunk.read(_stream(data[_PREFIX.size :]))
                data = _chunk_data(chunk)
                if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
                    raise McapError("checksum")
            return self._parse(data)
        except _DAMAGE:
            self.damaged[block.offset] = (block.start_ns, block.end_ns)
            return []

    def _parse(self, data: bytes) -> list[Message]:
        messages = []
        for opcode, body in _records(data):
            if opcode == Opcode.MESSAGE:
                channel_id, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
                if channel_id not in self.channels:
                    raise McapError("message of a channel that is not declared")
                payload = bytes(body[_MESSAGE_HEAD.size :])
                messages.append(Message(channel_id, log_time, payload, publish_time, sequence))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._take_definition(opcode, body)
        return messages


def _chunk_data(chunk: Chunk) -> bytes:
    """Return the records of a chunk; raise ValueError if they do not have the stated size."""
    if not chunk.compression:
        return chunk.data
    if not chunk.uncompressed_size:
        return b""
    data = decompress(chunk.data, chunk.compression, min(chunk.uncompressed_size, MAX_BLOCK_BYTES))
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"chunk of {len(data)} bytes, stated are {chunk.uncompressed_size}")
    return data


def _stream(data: bytes | memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(data))


def _records(data: bytes) -> Iterator[tuple[int, memoryview]]:
    """Yield (opcode, body) of each record in `data`; an incomplete last record is ignored."""
    view = memoryview(data)
    position = 0
    while position + _PREFIX.size <= len(view):
        opcode, length = _PREFIX.unpack_from(view, position)
        position += _PREFIX.size
        if position + length > len(view):
            return
        yield opcode, view[position : position + length]
        position += length
