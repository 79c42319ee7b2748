"""Drawing of the occupancy grid in rerun, tile by tile.

Entities:
    map/grid/<row>_<column>    the known part of a tile, on the floor
"""

from __future__ import annotations

import numpy as np
import rerun as rr

from beamsplat.common.geometry.tracks import RateLimit
from beamsplat.common.mapfiles.grid_tiles import GridSource, TiledGrid
from beamsplat.services.monitor.rerun_writer import RerunWriter

GRID = "map/grid"


class GridLayer:
    """Stores the newest tiles, and draws those that have changed, at a limited rate."""

    def __init__(self, writer: RerunWriter, limits: RateLimit) -> None:
        self._writer = writer
        self._limits = limits
        self._grid = TiledGrid()
        self._undrawn: dict[tuple[int, int], int] = {}  # (row, column) -> stamp

    def tile(
        self, stamp_ns: int, source: GridSource, place: tuple[int, int], packed: bytes, last: bool
    ) -> None:
        """Store a tile of the occupancy grid, and draw the changed ones after the last tile of an update.

        Args:
            place: row and column of the tile.
            packed: its cells, see `common.mapfiles.grid_tiles`; the known part is drawn on the floor.
            last: no tile of the same update follows.

        Raises:
            ValueError: the tile is damaged.
        """
        before = self._grid.tiles.get(place)
        if self._grid.add(source, *place, packed):
            self._writer.log(GRID, rr.Clear(recursive=True), stamp_ns=stamp_ns)
            self._undrawn, before = {}, None
        if self._grid.tiles.get(place) != before:
            self._undrawn[place] = stamp_ns
        if last and self._undrawn and self._limits.due("grid", stamp_ns):
            self.finish()

    def finish(self) -> None:
        """Draw the tiles that have changed since the last drawing."""
        for (row, column), stamp_ns in self._undrawn.items():
            entity = f"{GRID}/{row}_{column}"
            if (row, column) in self._grid.tiles:
                self._draw_tile(entity, stamp_ns, row, column)
            else:
                self._writer.log(entity, rr.Clear(recursive=False), stamp_ns=stamp_ns)
        self._undrawn = {}

    def _draw_tile(self, entity: str, stamp_ns: int, row: int, column: int) -> None:
        source, occupancy = self._grid.source, self._grid.cells(row, column)
        assert source is not None  # there is a tile
        known = occupancy >= 0
        rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        part = occupancy[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        height, width = part.shape
        first = np.array([column, row]) * source.size + (columns[0], rows[0])
        corner_m = source.resolution_m * first
        drawing = rr.GridMap(
            data=np.ascontiguousarray(part[::-1]).tobytes(),  # the first row of an image is its top
            format=rr.components.ImageFormat(
                width=width, height=height, color_model="L", channel_datatype="U8"
            ),
            cell_size=source.resolution_m,
            translation=[
                corner_m[0],
                corner_m[1],
                -0.01,
            ],  # below the floor, so that objects on it are not hidden
            colormap=rr.components.Colormap.RvizMap,
        )
        self._writer.log(entity, drawing, stamp_ns=stamp_ns)
