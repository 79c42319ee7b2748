"""Binning of keyframes by camera pose, to find the keyframe that is most redundant."""

from __future__ import annotations

import math

import numpy as np

CELL_M = 1.0  # edge of a bin
SECTORS = 8  # heading sectors of 45 degrees

PoseBin = tuple[int, int, int, int]


def pose_bin(T_map_camera: np.ndarray) -> PoseBin:
    """Return the bin of a camera pose: its 1 m cell (x, y, z) and its heading sector."""
    x, y, z = (math.floor(value / CELL_M) for value in T_map_camera[:3, 3])
    heading_rad = math.atan2(T_map_camera[1, 2], T_map_camera[0, 2])
    return x, y, z, math.floor(heading_rad / (2.0 * math.pi) * SECTORS) % SECTORS


class PoseBins:
    """The ids of keyframes, grouped by the bin of their camera pose."""

    def __init__(self) -> None:
        self._bin: dict[int, PoseBin] = {}
        self._ids: dict[PoseBin, set[int]] = {}

    def __len__(self) -> int:
        return len(self._bin)

    def insert(self, id: int, T_map_camera: np.ndarray) -> None:
        """Add a keyframe, or move it to the bin of its new pose."""
        self.remove(id)
        bin = pose_bin(T_map_camera)
        self._bin[id] = bin
        self._ids.setdefault(bin, set()).add(id)

    def remove(self, id: int) -> None:
        """Remove a keyframe; no effect if there is none with that id."""
        bin = self._bin.pop(id, None)
        if bin is not None:
            self._ids[bin].discard(id)
            if not self._ids[bin]:
                del self._ids[bin]

    def fullest(self, excluded: set[int]) -> list[int]:
        """Return the ids in the fullest bin, ascending, without the ids `excluded`; empty if none is left.

        Bins with excluded ids only are skipped. The result does not depend on the order of insertion.
        """
        candidates = [(len(ids), bin) for bin, ids in self._ids.items() if not ids <= excluded]
        return sorted(self._ids[max(candidates)[1]] - excluded) if candidates else []
