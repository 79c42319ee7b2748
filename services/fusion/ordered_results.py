"""Results in the order in which their work was begun, although some of it takes longer."""

from __future__ import annotations

from collections import OrderedDict
from typing import Generic, TypeVar

T = TypeVar("T")


class OrderedResults(Generic[T]):
    """Hands out results in the order of `begin`. Finished results wait for an earlier one that is not.

    At most `most` of them wait; beyond that the oldest finished result is handed out before its turn, so that
    work that never ends delays the others, but does not stop them.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._begun = 0
        self._open: OrderedDict[int, T | None] = OrderedDict()  # number -> result; None = not finished

    def begin(self) -> int:
        """Return the number of a new piece of work, for `finish`."""
        self._begun += 1
        self._open[self._begun] = None
        return self._begun

    def finish(self, number: int, result: T) -> list[T]:
        """Store a result; return the results that are handed out now."""
        self._open[number] = result
        out: list[T] = []
        while self._open and (first := next(iter(self._open.values()))) is not None:
            self._open.popitem(last=False)
            out.append(first)
        finished = [n for n, waiting in self._open.items() if waiting is not None]
        for n in finished[: max(len(finished) - self._most, 0)]:
            waiting = self._open.pop(n)
            assert waiting is not None  # `finished` has only these
            out.append(waiting)
        return out
