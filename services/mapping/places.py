"""Which keyframe is missed least: one of the place that is seen most often."""

from __future__ import annotations

import math

import numpy as np

CELL_M = 1.0
SECTORS = 8  # of the compass

Place = tuple[int, int, int, int]


def place_of(T_map_camera: np.ndarray) -> Place:
    """The cubic metre that a camera stands in, and the eighth of the compass that it looks to."""
    x, y, z = (math.floor(value / CELL_M) for value in T_map_camera[:3, 3])
    heading_rad = math.atan2(T_map_camera[1, 2], T_map_camera[0, 2])
    return x, y, z, math.floor(heading_rad / (2.0 * math.pi) * SECTORS) % SECTORS


class Places:
    """The keyframes of a map by place."""

    def __init__(self) -> None:
        self._place: dict[int, Place] = {}
        self._ids: dict[Place, set[int]] = {}

    def __len__(self) -> int:
        return len(self._place)

    def put(self, id: int, T_map_camera: np.ndarray) -> None:
        """Takes a keyframe in, or notes that it has moved."""
        self.remove(id)
        place = place_of(T_map_camera)
        self._place[id] = place
        self._ids.setdefault(place, set()).add(id)

    def remove(self, id: int) -> None:
        """Strikes a keyframe off."""
        place = self._place.pop(id, None)
        if place is not None:
            self._ids[place].discard(id)
            if not self._ids[place]:
                del self._ids[place]

    def fullest(self, spared: set[int]) -> list[int]:
        """Ids, rising, of the place with most keyframes that has any beside those `spared`, without them; the
        same places and ids give the same answer, whatever order they came in."""
        able = [(len(ids), place) for place, ids in self._ids.items() if not ids <= spared]
        return sorted(self._ids[max(able)[1]] - spared) if able else []
