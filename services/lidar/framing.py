"""Finds packets of fixed length in a stream of bytes that may begin anywhere, lose bytes and have wrong ones.

Once in step, a packet with wrong bytes is passed over in place: the next one begins where it should. Only
when several in a row do not even begin like packets is the step lost and searched for again, and found
where several packets in a row begin as they should and the first is whole. A search that trusted the
first match would take chance bytes for packets: an 8 bit checksum fits one in 256 times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

_LOST_AFTER = 3  # packets in a row that do not begin like one
_HEAD = 2  # bytes that `begins` must be content with where packets are followed
_DOUBTED_AFTER = 24  # packets in a row whose checksum fails


@dataclass
class Counters:
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
    """Packets of `length` bytes. `begins(packet)` looks at the head only, `whole(packet)` at the checksum."""

    def __init__(
        self,
        length: int,
        begins: Callable[[bytes], bool],
        whole: Callable[[bytes], bool],
        counters: Counters,
        in_a_row: int = 3,  # so many must begin like packets before the step is believed
        followed: bool = False,  # believe a packet only once one begins behind it
    ) -> None:
        self.length = length
        self._begins = begins
        self._whole = whole
        self._in_a_row = in_a_row
        self._followed = followed
        self._counters = counters
        self._buffer = bytearray()
        self._locked = False
        self._headless = 0
        self._failed = 0

    @property
    def pending(self) -> int:
        """Packets that have come but wait for what follows them."""
        return len(self._buffer) // self.length if self._locked else 0

    def feed(self, data: bytes) -> Iterator[bytes | None]:
        """The packets that `data` completes, in order; None for each that was there but is not good."""
        self._counters.bytes += len(data)
        self._buffer += data
        while True:
            if not self._locked and not self._search():
                return
            if len(self._buffer) < self.length:
                return
            packet = bytes(self._buffer[: self.length])
            headed = self._begins(packet)
            good = headed and self._whole(packet)
            if good and self._followed:
                if (behind := self._behind()) is None:
                    return
                good = behind
            if good:
                self._headless = self._failed = 0
                self._counters.packets += 1
                self._take(self.length)
                yield packet
                continue
            self._counters.bad_packets += 1
            self._headless = 0 if headed else self._headless + 1
            self._failed += 1
            if self._headless >= _LOST_AFTER or self._failed >= _DOUBTED_AFTER:
                self._locked = False
                self._headless = self._failed = 0
                self._skip(1)
            else:
                self._take(self.length)
            yield None

    def _behind(self) -> bool | None:
        """Whether another packet begins where this one ends, or one later; None: not there yet.

        Bytes lost inside a packet make one of its head and of the next one's data, which an 8 bit checksum
        takes for whole one time in 256; but then nothing begins where it ends.
        """
        for start in (self.length, 2 * self.length):
            head = bytes(self._buffer[start : start + _HEAD])
            if len(head) < _HEAD:
                return None
            if self._begins(head):
                return True
        return False

    def _search(self) -> bool:
        """Drops bytes until the buffer begins with packets in a row; False if more are needed for that."""
        needed = self.length * self._in_a_row
        start = 0
        while start + needed <= len(self._buffer):
            candidates = (
                bytes(self._buffer[start + i * self.length : start + (i + 1) * self.length])
                for i in range(self._in_a_row)
            )
            first = next(candidates)
            if self._begins(first) and self._whole(first) and all(map(self._begins, candidates)):
                self._locked = True
                break
            start += 1
        self._skip(start)
        return self._locked

    def _take(self, count: int) -> None:
        del self._buffer[:count]

    def _skip(self, count: int) -> None:
        self._counters.skipped_bytes += count
        self._take(count)
