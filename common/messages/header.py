"""What rides beside every message as Zenoh's attachment: readable without decoding the payload.

Clocks of two hosts are never compared: `publish_ns` is the publisher's monotonic clock, and
`clock_id` tells whose. Only where it equals one's own is `age_ns` known.
"""

from __future__ import annotations

import hashlib
import struct
import time
from dataclasses import dataclass
from pathlib import Path

_LAYOUT = struct.Struct("<2sBBqqQQI")  # magic, layout version, producer length, then the numbers
_MAGIC = b"BS"
_VERSION = 1
_INSTANCE_BYTES = 8


class DecodeError(ValueError):
    """Bytes that are not the message they claim to be."""


def local_clock_id() -> int:
    """uint64 naming this host's monotonic clock: a hash of the boot id, which containers share."""
    boot_id = Path("/proc/sys/kernel/random/boot_id")
    text = boot_id.read_text() if boot_id.exists() else f"{time.time() - time.monotonic():.0f}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")


@dataclass(frozen=True, slots=True)
class Header:
    """Who sent what when."""

    stamp_ns: int  # measurement time of the message
    publish_ns: int  # publisher's monotonic clock
    clock_id: int  # uint64: whose monotonic clock
    sequence: int  # counts up by one per topic, instance and epoch
    epoch: int  # uint32: takeover count; consumers ignore lower ones
    producer: str  # node name
    instance: str  # 16 hex digits, random per process start

    def pack(self) -> bytes:
        """The attachment's bytes."""
        producer = self.producer.encode()
        return (
            _LAYOUT.pack(
                _MAGIC, _VERSION, len(producer),
                self.stamp_ns, self.publish_ns, self.clock_id, self.sequence, self.epoch,
            )
            + bytes.fromhex(self.instance)
            + producer
        )  # fmt: skip

    @staticmethod
    def unpack(data: bytes) -> Header:
        """Header of attachment bytes.

        Raises:
            DecodeError: too short, not ours, or of another layout version.
        """
        if len(data) < _LAYOUT.size + _INSTANCE_BYTES:
            raise DecodeError(f"header of {len(data)} bytes is too short")
        magic, version, length, stamp_ns, publish_ns, clock_id, sequence, epoch = _LAYOUT.unpack_from(data)
        if magic != _MAGIC or version != _VERSION:
            raise DecodeError(f"header starts with {data[:3]!r}, expected {_MAGIC!r} version {_VERSION}")
        instance_end = _LAYOUT.size + _INSTANCE_BYTES
        if len(data) != instance_end + length:
            raise DecodeError(f"header of {len(data)} bytes, expected {instance_end + length}")
        try:
            producer = data[instance_end:].decode()
        except UnicodeDecodeError as error:
            raise DecodeError(f"header's producer is not text: {error}") from error
        instance = data[_LAYOUT.size : instance_end].hex()
        return Header(stamp_ns, publish_ns, clock_id, sequence, epoch, producer, instance)

    def age_ns(self, now_ns: int, clock_id: int) -> int | None:
        """Time since publication, or None where the clock is another host's."""
        return now_ns - self.publish_ns if clock_id == self.clock_id else None
