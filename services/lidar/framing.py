"""Search for packets of fixed length in a byte stream with lost and wrong bytes.

While synchronized, a damaged packet is skipped: the next packet starts one packet length later. Only several
consecutive packets with a wrong header mean that synchronization is lost. Synchronization is restored where
several consecutive packets start with a header and the first one has a correct checksum. A search that
accepted the first match would accept random bytes: an 8 bit checksum is correct by chance one time in 256.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

_SYNC_LOST_AFTER = 3  # packets in a row without a header: synchronization is lost
_HEAD = 2  # bytes on which `has_header` must decide if `check_next_header` is set
_RESYNC_AFTER = 24  # packets in a row with a wrong checksum: search again


@dataclass
class StreamCounters:
    """Counters of packets, samples and revolutions of a stream since it was first opened."""

    bytes: int = 0
    packets: int = 0  # with correct header and checksum
    bad_packets: int = 0  # at the expected place, but with a wrong header or checksum
    skipped_bytes: int = 0  # while searching for a packet
    lost_samples: int = 0  # expected measurements that are missing or were rejected
    scans: int = 0
    dropped_scans: int = 0  # revolutions with too few measurements

    def __str__(self) -> str:
        return (
            f"{self.scans} scans ({self.dropped_scans} dropped), {self.packets} packets "
            f"({self.bad_packets} bad), {self.lost_samples} samples lost, {self.skipped_bytes} bytes skipped"
        )


class Framer:
    """Splits a byte stream into packets of `length` bytes.

    `has_header(packet)` checks the first bytes only, `checksum_ok(packet)` the checksum.
    """

    def __init__(
        self,
        length: int,
        has_header: Callable[[bytes], bool],
        checksum_ok: Callable[[bytes], bool],
        counters: StreamCounters,
        confirm_packets: int = 3,  # consecutive headers needed to synchronize
        check_next_header: bool = False,  # accept a packet only if a header follows it
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
        """Return the number of complete packets in the buffer that wait for the header after them."""
        return len(self._buffer) // self.length if self._synchronized else 0

    def feed(self, data: bytes) -> Iterator[bytes | None]:
        """Yield the packets that are complete after adding `data`, in order; None for each damaged packet."""
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
            if self._bad_headers >= _SYNC_LOST_AFTER or self._bad_in_a_row >= _RESYNC_AFTER:
                self._synchronized = False
                self._bad_headers = self._bad_in_a_row = 0
                self._skip(1)
            else:
                self._consume(self.length)
            yield None

    def _next_header_follows(self) -> bool | None:
        """Return whether a header follows this packet directly or one packet later; None if not yet received.

        If bytes are lost within a packet, its start and the data of the next packet look like one packet,
        which an 8 bit checksum accepts one time in 256; but no header follows the end of such a packet.
        """
        for start in (self.length, 2 * self.length):
            head = bytes(self._buffer[start : start + _HEAD])
            if len(head) < _HEAD:
                return None
            if self._has_header(head):
                return True
        return False

    def _search(self) -> bool:
        """Drop bytes until consecutive packets start the buffer; return False if more bytes are needed."""
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
