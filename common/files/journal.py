"""Append-only files of records, for states of which most parts never change.

A record has a kind, a payload and a checksum. The length up to which a file is valid is stored elsewhere, in
a manifest that is replaced atomically: what a crash has left behind it is ignored, and overwritten.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from beamsplat.common.errors import UserError, reason

_HEAD = struct.Struct("<HHIQ")  # magic, kind, CRC-32 of the payload, size of the payload
_MAGIC = 0x4A42
_MAX_RECORD_BYTES = 1 << 30

Record = tuple[int, bytes]  # kind, payload


def record_bytes(payload_bytes: int) -> int:
    """Return the size in a file of a record with a payload of this size."""
    return _HEAD.size + payload_bytes


def append_records(path: Path, length: int, records: Iterable[Record]) -> int:
    """Write records behind the first `length` bytes of a file, flush it to the disk, and return its length.

    What follows these bytes is removed first. `length` 0 creates the file. Records are written one at a time:
    an iterator needs the memory of one record.

    Raises:
        OSError: the disk is full or broken; the first `length` bytes are unchanged.
    """
    with path.open("r+b" if length else "xb") as file:
        if length:
            file.truncate(length)
            file.seek(length)
        for kind, payload in records:
            file.write(_HEAD.pack(_MAGIC, kind, zlib.crc32(payload), len(payload)))
            file.write(payload)
            length += record_bytes(len(payload))
        file.flush()
        os.fsync(file.fileno())
    return length


def read_records(path: Path, length: int) -> Iterator[Record]:
    """Yield the records in the first `length` bytes of a file.

    Raises:
        UserError: the file is missing, truncated or altered.
    """
    try:
        with path.open("rb") as file:
            left = length
            while left > 0:
                head = file.read(_HEAD.size)
                if len(head) < _HEAD.size:
                    raise _damaged(path, length - left, "truncated")
                magic, kind, checksum, size = _HEAD.unpack(head)
                if magic != _MAGIC or record_bytes(size) > left or size > _MAX_RECORD_BYTES:
                    raise _damaged(path, length - left, "altered")
                payload = file.read(size)
                if len(payload) < size:
                    raise _damaged(path, length - left, "truncated")
                if zlib.crc32(payload) != checksum:
                    raise _damaged(path, length - left, "altered")
                left -= record_bytes(size)
                yield kind, payload
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({reason(error)}); restore it from a copy") from error


def _damaged(path: Path, position: int, what: str) -> UserError:
    return UserError(f"{path}: {what} at byte {position}; restore it from a copy")
