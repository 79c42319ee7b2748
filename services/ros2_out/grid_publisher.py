"""The map for ROS 2: the whole grid at intervals, and its changed tiles between them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from beamsplat.common.mapfiles.grid_tiles import UNKNOWN, GridSource, TiledGrid
from beamsplat.services.ros2_out import conversions

# Of the whole grid, on average: a grid of 20 million cells (200 m x 250 m at 5 cm) follows after 10 s.
_CELLS_PER_S = 2e6


class GridPublisher:
    """Assembles the tiles of the grid and decides what is published after an update.

    As nav2 and RViz expect, updates refer to the last whole grid; a whole grid is latched for later nodes.
    """

    def __init__(self, frame: str, every_s: float) -> None:
        self._frame = frame
        self._every_s = every_s
        self._grid = TiledGrid()
        self._changed: set[tuple[int, int]] = set()
        self._whole: tuple[GridSource, tuple[int, int, int, int]] | None = None  # of the last whole grid
        self._whole_ns = 0

    def add(self, source: GridSource, row: int, column: int, packed: bytes) -> None:
        """Store a tile. Raises ValueError if it is damaged."""
        before = self._grid.tiles.get((row, column))
        if self._grid.add(source, row, column, packed) or packed != (before or b""):
            self._changed.add((row, column))

    def messages(self, stamp_ns: int) -> Iterator[tuple[str, Any]]:
        """Yield ("map" or "map_updates", ROS message) of what is due after an update, with its stamp.

        Raises:
            ValueError: the grid is too large for one message.
        """
        source, bounds = self._grid.source, self._grid.bounds()
        if source is None or not self._grid.tiles or not self._changed:
            return
        cells = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1]) * source.size**2
        age_s = abs(stamp_ns - self._whole_ns) * 1e-9
        if self._whole != (source, bounds) or age_s >= max(self._every_s, cells / _CELLS_PER_S):
            occupancy = self._grid.assembled()
            self._whole, self._whole_ns = (source, bounds), stamp_ns
            yield (
                "map",
                conversions.occupancy_grid(
                    stamp_ns, self._frame, source.resolution_m, self._grid.origin_m(), occupancy
                ),
            )
            self._changed.clear()
            return
        for row, column in sorted(self._changed):
            known = (row, column) in self._grid.tiles
            shape = (source.size, source.size)
            part = self._grid.cells(row, column) if known else np.full(shape, UNKNOWN, dtype=np.int8)
            first = (row - bounds[0]) * source.size, (column - bounds[1]) * source.size
            yield "map_updates", conversions.grid_update(stamp_ns, self._frame, *first, part)
        self._changed.clear()
