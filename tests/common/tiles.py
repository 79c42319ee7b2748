"""Grid messages for tests: any occupancy grid as the tiles of one update."""

import numpy as np

from beamsplat.common.mapfiles.grid_tiles import pack_tile
from beamsplat.common.messages import GridTile


def tile(stamp_ns, cells, row=0, column=0, resolution_m=0.1, **fields):
    """Return a message with one tile of square `cells` int8 [S, S]."""
    packed = np.frombuffer(pack_tile(np.asarray(cells, np.int8)), np.uint8)
    return GridTile(
        stamp_ns=stamp_ns, resolution_m=resolution_m, size=len(cells), row=row, column=column, packed=packed,
        **fields,
    )  # fmt: skip


def tiles(stamp_ns, occupancy, first, size, resolution_m=0.1, **fields):
    """Return the messages of a grid int8 [H, W] whose cell (0, 0) is the cell `first` (row, column)."""
    rows, columns = occupancy.shape
    low = np.array(first) // size
    high = -(-np.add(first, (rows, columns)) // size)
    whole = np.full((high - low) * size, -1, np.int8)
    top, left = np.array(first) - low * size
    whole[top : top + rows, left : left + columns] = occupancy
    places = [(r, c) for r in range(high[0] - low[0]) for c in range(high[1] - low[1])]
    return [
        tile(
            stamp_ns, whole[r * size : (r + 1) * size, c * size : (c + 1) * size], int(low[0] + r),
            int(low[1] + c), resolution_m, remaining=len(places) - sent, **fields,
        )
        for sent, (r, c) in enumerate(places, start=1)
    ]  # fmt: skip
