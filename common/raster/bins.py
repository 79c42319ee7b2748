"""Binning: lists of splats per tile, nearest first, by a parallel stable counting sort of the pairs.

A pair is a splat and a tile that it overlaps. Arrays, with V visible splats: `order` int32 [V] contains the
splats in order of depth, cut into `BATCHES` batches; `first_pair` and `pair_count` int32 [V] are the index of
the first pair and the number of pairs of each splat; `tiles` and `rows` int32 are the tile and the range of
rows of each pair.
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.common.raster.layout import BATCHES
from beamsplat.common.raster.project import batch_size
from beamsplat.common.raster.simd_memory import atomic_next


@kernel
def count_pairs(
    counter: np.ndarray,
    visible: int,
    order: np.ndarray,
    first_pair: np.ndarray,
    pair_count: np.ndarray,
    tiles: np.ndarray,
    per_tile: np.ndarray,
) -> None:
    """Count the (splat, tile) pairs of each batch in each tile; write to `per_tile` int32 [BATCHES, tiles].

    The other arrays: see the module. `counter` int64 [1] assigns the batches to threads.
    """
    size = batch_size(visible)
    while True:
        batch = atomic_next(counter, 0)
        if batch >= BATCHES:
            return
        per_tile[batch, :] = 0
        for rank in range(batch * size, min(visible, (batch + 1) * size)):
            first = first_pair[order[rank]]
            for pair in range(first, first + pair_count[order[rank]]):
                per_tile[batch, tiles[pair]] += 1


@kernel
def prefix_sum(per_tile: np.ndarray, tile_start: np.ndarray) -> int:
    """Replace the counts in `per_tile` by start rows in `lists`, and return the total number of pairs.

    The start rows are an exclusive prefix sum over tiles and, within a tile, over batches. `tile_start` int64
    [tiles + 1] receives the first row of each tile.
    """
    total = 0
    for tile in range(per_tile.shape[1]):
        tile_start[tile] = total
        for batch in range(BATCHES):
            here = per_tile[batch, tile]
            per_tile[batch, tile] = total
            total += here
    tile_start[per_tile.shape[1]] = total
    return total


@kernel
def scatter(
    counter: np.ndarray,
    visible: int,
    order: np.ndarray,
    first_pair: np.ndarray,
    pair_count: np.ndarray,
    tiles: np.ndarray,
    rows: np.ndarray,
    per_tile: np.ndarray,
    lists: np.ndarray,
) -> None:
    """Sort the pairs by tile: write (splat, rows) of each pair to `lists` int32 [pairs, 2].

    tiles[pair] is overwritten with the row of the pair in `lists`.
    """
    size = batch_size(visible)
    while True:
        batch = atomic_next(counter, 0)
        if batch >= BATCHES:
            return
        for rank in range(batch * size, min(visible, (batch + 1) * size)):
            splat = order[rank]
            first = first_pair[splat]
            for pair in range(first, first + pair_count[splat]):
                tile = tiles[pair]
                at = per_tile[batch, tile]
                per_tile[batch, tile] = at + 1
                lists[at, 0], lists[at, 1] = splat, rows[pair]
                tiles[pair] = at
