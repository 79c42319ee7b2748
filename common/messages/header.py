"""The header of a message, sent as Zenoh's attachment: readable without decoding the payload.

`publish_ns` is a time of the publisher's monotonic clock, which `clock_id` identifies. Times of different
hosts' clocks are never compared: `age_ns` is known only if publisher and receiver run on one host.
"""

from __future__ import annotations

import hashlib
import struct
import time
from dataclasses import dataclass
from pathlib import Path

_LAYOUT = struct.Struct("<2sBBqqQQI")  # magic, layout version, producer length, then the numbers
_BACKLOG = struct.Struct("<I")  # follows the numbers in version 2
_MAGIC = b"BS"
# A header without a backlog is of version 1, so that programs from before 2 read all other messages.
_VERSIONS = (1, 2)
MAX_BACKLOG = 2**32 - 1
_INSTANCE_BYTES = 8


class DecodeError(ValueError):
    """The bytes are not a valid message of the stated schema, or not a valid header."""


def local_clock_id() -> int:
    """Return the uint64 id of this host's monotonic clock: a hash of the boot id, equal in all containers."""
    boot_id = Path("/proc/sys/kernel/random/boot_id")
    text = boot_id.read_text() if boot_id.exists() else f"{time.time() - time.monotonic():.0f}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")


@dataclass(frozen=True, slots=True)
class Header:
    """Publisher, time and sequence number of one message."""

    stamp_ns: int  # measurement time of the message
    publish_ns: int  # time of publication, publisher's monotonic clock
    clock_id: int  # uint64 id of that clock (`local_clock_id`)
    sequence: int  # counts up by one per message of one topic, instance and epoch
    epoch: int  # uint32: counts the hand-overs of the node; subscribers ignore lower epochs
    producer: str  # node name
    instance: str  # 16 hex digits, random per process start
    backlog: int = 0  # uint32: messages of this topic that the publisher has sent, not acknowledged so far

    def pack(self) -> bytes:
        """Return the header as bytes, for Zenoh's attachment."""
        producer = self.producer.encode()
        return (
            _LAYOUT.pack(
                _MAGIC, 2 if self.backlog else 1, len(producer),
                self.stamp_ns, self.publish_ns, self.clock_id, self.sequence, self.epoch,
            )
            + (_BACKLOG.pack(self.backlog) if self.backlog else b"")
            + bytes.fromhex(self.instance)
            + producer
        )  # fmt: skip

    @staticmethod
    def unpack(data: bytes) -> Header:
        """Return the header in the bytes of an attachment.

        Raises:
            DecodeError: the bytes are too short or too long, have another magic or another layout version.
        """
        if len(data) < _LAYOUT.size + _INSTANCE_BYTES:
            raise DecodeError(f"header of {len(data)} bytes is too short")
        magic, version, length, stamp_ns, publish_ns, clock_id, sequence, epoch = _LAYOUT.unpack_from(data)
        if magic != _MAGIC or version not in _VERSIONS:
            raise DecodeError(f"header starts with {data[:3]!r}, expected {_MAGIC!r} version 1 or 2")
        start, backlog = _LAYOUT.size, 0
        if version == 2:
            (backlog,) = _BACKLOG.unpack_from(data, start)  # present: an instance id is longer
            start += _BACKLOG.size
        instance_end = start + _INSTANCE_BYTES
        if len(data) != instance_end + length:
            raise DecodeError(f"header of {len(data)} bytes, expected {instance_end + length}")
        try:
            producer = data[instance_end:].decode()
        except UnicodeDecodeError as error:
            raise DecodeError(f"header's producer is not text: {error}") from error
        instance = data[start:instance_end].hex()
        return Header(stamp_ns, publish_ns, clock_id, sequence, epoch, producer, instance, backlog)

    def age_ns(self, now_ns: int, clock_id: int) -> int | None:
        """Return the time in ns from publication to `now_ns`, a reading of `time.monotonic_ns`.

        Return None if the message was published with another clock than `clock_id`: on another host.
        """
        return now_ns - self.publish_ns if clock_id == self.clock_id else None
