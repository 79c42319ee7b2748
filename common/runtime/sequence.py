"""Sequence numbers of one producer on one stream: gaps, messages that fill them later, and repetitions."""

from __future__ import annotations

from typing import Literal, NamedTuple

RECOVERY_NS = 5_000_000_000  # a gap in which nothing arrives for so long is lost
MAX_GAPS = 64  # beyond that, two neighbours are merged
MAX_JUMP = 100_000  # messages; more than a producer sends during `RECOVERY_NS`


class _Gap(NamedTuple):
    start: int
    end: int  # exclusive
    since_ns: int  # of the last arrival next to it


class SequenceTracker:
    """The sequence numbers that have arrived from one process, and those that are missing.

    A missing number is in a gap until it arrives (late) or the gap is given up (lost).
    """

    def __init__(self, first: int | None) -> None:
        """`first`: the first sequence number of the process; None: the first one that arrives."""
        self.next = first
        self.lost = 0  # numbers of the gaps that were given up
        self._gaps: list[_Gap] = []

    def add(self, sequence: int, now_ns: int) -> Literal["next", "late", "repeated"]:
        """Record the arrival of `sequence`; return whether it is newer than all others, late, or repeated."""
        self.give_up(now_ns)
        if self.next is None or sequence >= self.next:
            if self.next is not None and sequence > self.next:
                self._gaps.append(_Gap(self.next, sequence, now_ns))
                self._merge_surplus()
            self.next = sequence + 1
            return "next"
        for number, gap in enumerate(self._gaps):
            if gap.start <= sequence < gap.end:
                parts = (_Gap(gap.start, sequence, now_ns), _Gap(sequence + 1, gap.end, now_ns))
                self._gaps[number : number + 1] = [part for part in parts if part.start < part.end]
                self._merge_surplus()
                return "late"
        return "repeated"

    def give_up(self, now_ns: int | None) -> None:
        """Count the gaps as lost in which nothing has arrived for `RECOVERY_NS`; None: all gaps."""
        old = [gap for gap in self._gaps if now_ns is None or now_ns - gap.since_ns > RECOVERY_NS]
        for gap in old:
            self._gaps.remove(gap)
            self._lose(gap)

    def _merge_surplus(self) -> None:
        """Merge the two gaps with the fewest arrived messages between them, if there are too many gaps.

        To give one up instead would reject its messages, perhaps all that follow: somebody else's sequence
        numbers can be the cause of the gaps.
        """
        if len(self._gaps) <= MAX_GAPS:
            return
        at = min(range(len(self._gaps) - 1), key=lambda i: self._gaps[i + 1].start - self._gaps[i].end)
        first, second = self._gaps[at : at + 2]
        merged = _Gap(first.start, second.end, max(first.since_ns, second.since_ns))
        self._gaps[at : at + 2] = [merged]

    def missing(self) -> list[tuple[int, int]]:
        """Return the missing numbers as intervals [start, end)."""
        return [(gap.start, gap.end) for gap in self._gaps]

    def _lose(self, gap: _Gap) -> None:
        self.lost += gap.end - gap.start
