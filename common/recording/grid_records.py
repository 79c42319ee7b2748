"""The occupancy grid in recordings: whole ROS messages for other tools, beside the tiles."""

from __future__ import annotations

import contextlib

from beamsplat.common.mapfiles.grid_tiles import GridSource, TiledGrid
from beamsplat.common.messages import Grid, GridTile, Message
from beamsplat.common.recording.to_ros import RosRecord, records_of

TOPIC = "localization/grid"
# Of the whole grid, on average, and the least time between two: a grid of 100 m x 100 m follows after 10 s.
_CELLS_PER_S, _LEAST_S = 4e5, 5.0


class GridRecords:
    """Assembles the recorded tiles; yields the whole grid as nav_msgs/OccupancyGrid at intervals."""

    def __init__(self) -> None:
        self._grid = TiledGrid()
        self._written_ns: int | None = None

    def records_of(self, message: Message) -> list[RosRecord]:
        """Return the record to write with a message: the whole grid after the last tile of an update, if due.

        A grid that is too large for one message is not written; its tiles are.
        """
        if not isinstance(message, GridTile):
            return []
        m = message
        source = GridSource(m.map_uuid, m.since_ns, m.resolution_m, m.size)
        with contextlib.suppress(ValueError):  # a damaged tile, or a grid that is too large
            self._grid.add(source, m.row, m.column, m.packed.tobytes())
            if m.remaining == 0 and self._grid.tiles and self._is_due(m.stamp_ns, m.size):
                grid = Grid(
                    stamp_ns=m.stamp_ns, resolution_m=m.resolution_m, origin_m=self._grid.origin_m(),
                    occupancy=self._grid.assembled(),
                )  # fmt: skip
                self._written_ns = m.stamp_ns
                return [record._replace(role="display") for record in records_of(TOPIC, grid)]
        return []

    def _is_due(self, stamp_ns: int, size: int) -> bool:
        row0, column0, row1, column1 = self._grid.bounds()
        period_s = max((row1 - row0) * (column1 - column0) * size**2 / _CELLS_PER_S, _LEAST_S)
        return self._written_ns is None or abs(stamp_ns - self._written_ns) * 1e-9 >= period_s
