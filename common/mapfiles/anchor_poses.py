"""The newest pose of each anchor of a map, for its viewers."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

MAX_ANCHORS = 100_000  # of one map: far more than a building has


class AnchorPoses:
    """Poses of the anchors of one map, from chunks (one pose each) and from messages of all poses.

    Both carry a revision, which counts the moves of the anchors. The pose with the highest revision is valid,
    so that messages may arrive in any order.
    """

    def __init__(self) -> None:
        self._poses: dict[int, tuple[int, np.ndarray]] = {}  # anchor -> revision, T_map_anchor

    def update(
        self,
        revision: int,
        poses: Iterable[tuple[int, np.ndarray]],  # anchor id, T_map_anchor float64 [4, 4]
    ) -> list[int]:
        """Store poses of a revision, unless newer ones are known; return the anchors whose pose has changed.

        Raises:
            ValueError: the map has more than `MAX_ANCHORS` anchors.
        """
        changed = []
        for anchor, T_map_anchor in poses:
            known = self._poses.get(anchor)
            if known is not None and known[0] > revision:
                continue
            if known is None and len(self._poses) >= MAX_ANCHORS:
                raise ValueError(f"the map has more than {MAX_ANCHORS} anchors")
            self._poses[anchor] = (revision, T_map_anchor)
            if known is None or not np.array_equal(known[1], T_map_anchor):
                changed.append(anchor)
        return changed

    def pose(self, anchor: int) -> np.ndarray:
        """Return T_map_anchor float64 [4, 4]. Raises KeyError for an unknown anchor."""
        return self._poses[anchor][1]

    def entry(self, anchor: int) -> tuple[int, list[tuple[int, np.ndarray]]]:
        """Return an anchor's pose as arguments of `update`. Raises KeyError for an unknown anchor."""
        revision, T_map_anchor = self._poses[anchor]
        return revision, [(anchor, T_map_anchor)]

    def clear(self) -> None:
        """Forget all poses: another process of the mapper has another map."""
        self._poses.clear()
