"""Which optimisation steps are done at once after an insertion, and which later, while no keyframe waits.

A keyframe is inserted as soon as it is received; its steps need several times longer. While the mapper is
behind, fewer steps follow at once, so that the delay from the image to the map stays near a target. The other
steps are owed: they are done in the order in which they fell due, as soon as no keyframe waits.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, Literal

Kind = Literal["window", "refine"]  # of `Mapper.optimise` and of `Mapper.refine`

_LEAST_SHARE = 0.125  # of the half-size steps, at once at any delay: else new Gaussians stay as inserted
_MOST_OWED = 20_000  # steps, those of 870 keyframes; beyond that the oldest are dropped and counted
_PIECE_HALF, _PIECE_FULL = 8, 3  # steps of one piece, 0.1 s on one core: a keyframe waits for one piece


@dataclass(frozen=True)
class PlannedSteps:
    """Steps of one kind and image size (`mapper.FULL` or `HALF`)."""

    kind: Kind
    size: int
    count: int


class StepPlan:
    """The owed steps of a map."""

    def __init__(self) -> None:
        self._owed: deque[PlannedSteps] = deque()
        self.count = 0  # of owed steps
        self.dropped = 0  # steps beyond the limit, which are never done

    @staticmethod
    def at_once(delay_s: float, target_s: float, half: int, full: int) -> tuple[int, int]:
        """Return how many of `half` and `full` steps are done at once after an insertion.

        All without a delay, fewer the nearer the delay is to the target.

        Args:
            delay_s: from the image of the keyframe until now, in time of the data.
            target_s: wanted upper limit of this delay.
        """
        share = min(max(1.0 - delay_s / target_s, 0.0), 1.0)
        return math.ceil(half * max(share, _LEAST_SHARE)), math.ceil(full * share)

    def owe(self, kind: Kind, size: int, count: int, *, first: bool = False) -> None:
        """Add `count` steps to the owed ones: after all others, or before them (`first`)."""
        if count <= 0:
            return
        self.count += count
        end = 0 if first else -1
        if self._owed and (self._owed[end].kind, self._owed[end].size) == (kind, size):
            count += (self._owed.popleft() if first else self._owed.pop()).count
        self._owed.insert(0 if first else len(self._owed), PlannedSteps(kind, size, count))
        while self.count > _MOST_OWED:
            oldest = self._owed.popleft()
            gone = min(oldest.count, self.count - _MOST_OWED)
            self.count -= gone
            self.dropped += gone
            if gone < oldest.count:
                self._owed.appendleft(PlannedSteps(oldest.kind, oldest.size, oldest.count - gone))

    def mend(self, size: int, count: int) -> None:
        """Owe `count` steps on the whole map, before all others; anchors have moved.

        Moves of which the first is not mended yet are mended together.
        """
        first = self._owed[0] if self._owed else None
        waiting = first.count if first is not None and (first.kind, first.size) == ("refine", size) else 0
        self.owe("refine", size, count - waiting, first=True)

    def take(self, half_size: int) -> PlannedSteps | None:
        """Remove and return the next piece of owed steps; None if none are owed.

        `half_size` is the image size of which more steps fit into a piece.
        """
        if not self._owed:
            return None
        oldest = self._owed.popleft()
        count = min(oldest.count, _PIECE_HALF if oldest.size == half_size else _PIECE_FULL)
        if count < oldest.count:
            self._owed.appendleft(PlannedSteps(oldest.kind, oldest.size, oldest.count - count))
        self.count -= count
        return PlannedSteps(oldest.kind, oldest.size, count)

    def progress(self) -> list[list[Any]]:
        """Return the owed steps as JSON values, for `resume`."""
        return [[steps.kind, steps.size, steps.count] for steps in self._owed]

    def resume(self, progress: list[list[Any]]) -> None:
        """Owe what `progress` returned."""
        self._owed.clear()
        self.count = 0
        for kind, size, count in progress:
            self.owe(kind, size, count)
