"""The tier between a device's memory and the disk: blocks that are on disk and also in host memory."""

from __future__ import annotations

from beamsplat.common.mapfiles.blocks import Arrays


class BlockCache:
    """Arrays of blocks by number, within a limit of memory; those that were paged out first leave first.

    An engine in host memory needs none: its limit is 0.
    """

    def __init__(self) -> None:
        self.held_bytes = 0
        self._limit_bytes = 0.0
        self._blocks: dict[int, Arrays] = {}

    def __len__(self) -> int:
        return len(self._blocks)

    def limit(self, limit_bytes: float) -> None:
        """Set the memory of all blocks, and remove what exceeds it."""
        self._limit_bytes = limit_bytes
        while self.held_bytes > limit_bytes:
            self.remove(next(iter(self._blocks)))

    def put(self, number: int, arrays: Arrays) -> None:
        """Keep the arrays of a block as they were written, if they fit; others make room."""
        self.remove(number)
        size = _bytes(arrays)
        if size > self._limit_bytes:
            return
        self._blocks[number] = arrays
        self.held_bytes += size
        self.limit(self._limit_bytes)

    def get(self, number: int) -> Arrays | None:
        """Return the arrays of a block, which must not be changed; None if they are on disk only."""
        return self._blocks.get(number)

    def remove(self, number: int) -> None:
        """Free the memory of a block; no effect if it is on disk only."""
        arrays = self._blocks.pop(number, None)
        if arrays is not None:
            self.held_bytes -= _bytes(arrays)


def _bytes(arrays: Arrays) -> int:
    return sum(array.nbytes for array in arrays.values())
