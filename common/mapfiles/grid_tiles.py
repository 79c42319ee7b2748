"""Square tiles of the occupancy grid: packing, and the assembly of a grid from the newest tile of each place.

Tile (row, column) covers the cells with row numbers row * size .. (row + 1) * size - 1, and columns likewise.
The corner of cell (0, 0) of tile (0, 0) with the smallest x and y is the origin of the map frame.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

TILE_CELLS = 512  # edge of a tile: 25.6 m at 5 cm
MAX_TILE_CELLS = 1024  # larger tiles are refused
MAX_TILES = 4096  # of one grid: 1.6 km x 1.6 km at 5 cm
# Of a grid in one piece: 134 MB, 580 m x 580 m at 5 cm.
MAX_CELLS = 2**27
UNKNOWN = -1


def pack_tile(occupancy: np.ndarray) -> bytes:
    """Return a tile int8 [S, S], compressed; b"" if all of its cells are unknown."""
    return zlib.compress(occupancy.tobytes(), 1) if (occupancy != UNKNOWN).any() else b""


def unpack_tile(packed: bytes, size: int) -> np.ndarray:
    """Return the cells int8 [size, size] of a tile (inverse of `pack_tile`).

    Raises:
        ValueError: the bytes are damaged, or are not a tile of this size.
    """
    if not packed:
        return np.full((size, size), UNKNOWN, dtype=np.int8)
    unpacker = zlib.decompressobj()
    try:
        cells = unpacker.decompress(packed, size * size + 1)  # bounded: kilobytes can expand to gigabytes
    except zlib.error as error:
        raise ValueError(f"grid tile: damaged ({error})") from error
    if len(cells) != size * size or not unpacker.eof:
        raise ValueError(f"grid tile: {len(cells)} cells or more, expected {size} x {size}")
    return np.frombuffer(cells, dtype=np.int8).reshape(size, size)


@dataclass(frozen=True)
class GridSource:
    """The map and the process that tiles belong to; tiles of different sources are not combined."""

    map_uuid: str
    since_ns: int  # stamp of the first tile of the process
    resolution_m: float
    size: int  # edge of a tile in cells


class TiledGrid:
    """The newest tile of each place, compressed, of one source: about 5 kB per tile of a building."""

    def __init__(self, max_tiles: int = MAX_TILES) -> None:
        self.source: GridSource | None = None
        self.tiles: dict[tuple[int, int], bytes] = {}  # (row, column) -> packed cells
        self._max_tiles = max_tiles

    def add(self, source: GridSource, row: int, column: int, packed: bytes) -> bool:
        """Store a tile, or remove it if no cell is known; tiles of another source remove all earlier ones.

        Returns:
            Whether the source is another one than before.

        Raises:
            ValueError: the tile is damaged, or there are too many; the grid is unchanged.
        """
        known = (unpack_tile(packed, source.size) >= 0).any()
        changed = source != self.source
        if changed:
            self.source, self.tiles = source, {}
        if not known:
            self.tiles.pop((row, column), None)
        elif len(self.tiles) >= self._max_tiles and (row, column) not in self.tiles:
            raise ValueError(f"grid tile ({row}, {column}): more than {self._max_tiles} tiles in one grid")
        else:
            self.tiles[row, column] = packed
        return changed

    def copy(self) -> TiledGrid:
        """Return a copy for another thread, which later tiles do not change; the packed cells are shared."""
        out = TiledGrid(self._max_tiles)
        out.source, out.tiles = self.source, dict(self.tiles)
        return out

    def cells(self, row: int, column: int) -> np.ndarray:
        """Return the cells int8 [S, S] of a stored tile. Raises KeyError if there is none."""
        assert self.source is not None  # there is a tile
        return unpack_tile(self.tiles[row, column], self.source.size)

    def bounds(self) -> tuple[int, int, int, int]:
        """Return (row0, column0, row1, column1) of the stored tiles, half open; zeros without a tile."""
        if not self.tiles:
            return 0, 0, 0, 0
        places = np.array(list(self.tiles))
        (row0, column0), (row1, column1) = places.min(axis=0).tolist(), places.max(axis=0).tolist()
        return row0, column0, row1 + 1, column1 + 1

    def origin_m(self) -> np.ndarray:
        """Return the corner (x, y) of the lowest tile row and column in the map frame, float64 [2]."""
        row0, column0, _, _ = self.bounds()
        edge_m = 0.0 if self.source is None else self.source.size * self.source.resolution_m
        return np.array([column0 * edge_m, row0 * edge_m])

    def assembled(self, stride: int = 1, max_cells: int = MAX_CELLS) -> np.ndarray:
        """Return the grid in one piece, int8 [H, W]; cell (0, 0) is at `origin_m`.

        Args:
            stride: a power of two; each output cell has the highest occupancy of stride x stride cells.
            max_cells: largest number of cells of the result.

        Raises:
            ValueError: the result would be larger; a single far tile suffices for that.
        """
        row0, column0, row1, column1 = self.bounds()
        edge = 0 if self.source is None else self.source.size // stride
        shape = (row1 - row0) * edge, (column1 - column0) * edge
        if shape[0] * shape[1] > max_cells:
            raise ValueError(f"the grid has {shape[1]} x {shape[0]} cells, more than {max_cells}")
        out = np.full(shape, UNKNOWN, dtype=np.int8)
        for row, column in self.tiles:
            cells = self.cells(row, column)
            if stride > 1:
                cells = cells.reshape(edge, stride, edge, stride).max(axis=(1, 3))
            top, left = (row - row0) * edge, (column - column0) * edge
            out[top : top + edge, left : left + edge] = cells
        return out

    def stride_for(self, widest: int) -> int:
        """Return the smallest power of two at which `assembled` has at most `widest` rows and columns."""
        row0, column0, row1, column1 = self.bounds()
        size = 1 if self.source is None else self.source.size
        longest, stride = max(row1 - row0, column1 - column0) * size, 1
        while longest > widest * stride and stride < size:
            stride *= 2
        return stride
