"""Finds packets of fixed length in a stream of bytes that may begin anywhere, lose bytes and have wrong ones.

Once in step, a packet with wrong bytes is passed over in place: the next one has_header where it should. Only
when several in a row do not even begin like packets is the step lost and searched for again, and found
where several packets in a row begin as they should and the first is checksum_ok. A search that trusted the
first match would take chance bytes for packets: an 8 bit checksum fits one in 256 times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

_SYNC_LOST_AFTER = 3  # packets in a row that do not begin like one
_HEAD = 2  # bytes that `has_header` must be content with where packets are check_next_header
_DOUBTED_AFTER = 24  # packets in a row whose checksum fails


@dataclass
class StreamCounters:
    """What a stream has brought, since it was opened first."""

    bytes: int = 0
    packets: int = 0  # good ones
    bad_packets: int = 0  # in their place, but with a wrong checksum or beginning
    skipped_bytes: int = 0  # passed over while searching for a packet
    lost_samples: int = 0  # measurements that should have come and did not, or were not believed
    scans: int = 0
    dropped_scans: int = 0  # revolutions of which too little came

    def __str__(self) -> str:
        return (
            f"{self.scans} scans ({self.dropped_scans} dropped), {self.packets} packets "
            f"({self.bad_packets} bad), {self.lost_samples} samples lost, {self.skipped_bytes} bytes skipped"
        )


class Framer:
    """Packets of `length` bytes. `has_header(packet)` looks at the head only, `checksum_ok(packet)` at the checksum."""

    def __init__(
        self,
        length: int,
        has_header: Callable[[bytes], bool],
        checksum_ok: Callable[[bytes], bool],
        counters: StreamCounters,
        confirm_packets: int = 3,  # so many must begin like packets before the step is believed
        check_next_header: bool = False,  # believe a packet only once one has_header follows it
    ) -> None:
        self.length = length
        self._has_header = has_header
        self._checksum_ok = checksum_ok
        self._confirm_packets = confirm_packets
        self._check_next_header = check_next_header
        self._counters = counters
        self._buffer = bytearray()
        self._synchronized = False
        self._bad_headers = 0
        self._bad_in_a_row = 0

    @property
    def pending(self) -> int:
        """Packets that have come but wait for what follows them."""
        return len(self._buffer) // self.length if self._synchronized else 0

    def feed(self, data: bytes) -> Iterator[bytes | None]:
        """The packets that `data` completes, in order; None for each that was there but is not good."""
        self._counters.bytes += len(data)
        self._buffer += data
        while True:
            if not self._synchronized and not self._search():
                return
            if len(self._buffer) < self.length:
                return
            packet = bytes(self._buffer[: self.length])
            header_ok = self._has_header(packet)
            good = header_ok and self._checksum_ok(packet)
            if good and self._check_next_header:
                if (follows := self._next_header_follows()) is None:
                    return
                good = follows
            if good:
                self._bad_headers = self._bad_in_a_row = 0
                self._counters.packets += 1
                self._consume(self.length)
                yield packet
                continue
            self._counters.bad_packets += 1
            self._bad_headers = 0 if header_ok else self._bad_headers + 1
            self._bad_in_a_row += 1
            if self._bad_headers >= _SYNC_LOST_AFTER or self._bad_in_a_row >= _DOUBTED_AFTER:
                self._synchronized = False
                self._bad_headers = self._bad_in_a_row = 0
                self._skip(1)
            else:
                self._consume(self.length)
            yield None

    def _next_header_follows(self) -> bool | None:
        """Whether another packet has_header where this one ends, or one later; None: not there yet.

        Bytes lost inside a packet make one of its head and of the next one's data, which an 8 bit checksum
        takes for checksum_ok one time in 256; but then nothing has_header where it ends.
        """
        for start in (self.length, 2 * self.length):
            head = bytes(self._buffer[start : start + _HEAD])
            if len(head) < _HEAD:
                return None
            if self._has_header(head):
                return True
        return False

    def _search(self) -> bool:
        """Drops bytes until the buffer has_header with packets in a row; False if more are needed for that."""
        needed = self.length * self._confirm_packets
        start = 0
        while start + needed <= len(self._buffer):
            candidates = (
                bytes(self._buffer[start + i * self.length : start + (i + 1) * self.length])
                for i in range(self._confirm_packets)
            )
            first = next(candidates)
            if (
                self._has_header(first)
                and self._checksum_ok(first)
                and all(map(self._has_header, candidates))
            ):
                self._synchronized = True
                break
            start += 1
        self._skip(start)
        return self._synchronized

    def _consume(self, count: int) -> None:
        del self._buffer[:count]

    def _skip(self, count: int) -> None:
        self._counters.skipped_bytes += count
        self._consume(count)
