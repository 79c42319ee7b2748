"""Lists of splats per tile, nearest first: a stable counting sort of the pairs, in parallel parts."""

from __future__ import annotations

from beamsplat.common.compiled import kernel
from beamsplat.common.raster.layout import CHUNKS
from beamsplat.common.raster.project import chunk_size
from beamsplat.common.raster.simd_memory import atomic_next


@kernel
def count(counter, visible, order, first_pair, pair_count, tiles, per_tile):  # noqa: ANN001, ANN201
    """per_tile [CHUNKS, tiles]: pairs of each part of the depth order in each tile."""
    size = chunk_size(visible)
    while True:
        chunk = atomic_next(counter, 0)
        if chunk >= CHUNKS:
            return
        per_tile[chunk, :] = 0
        for rank in range(chunk * size, min(visible, (chunk + 1) * size)):
            first = first_pair[order[rank]]
            for pair in range(first, first + pair_count[order[rank]]):
                per_tile[chunk, tiles[pair]] += 1


@kernel
def place(per_tile, tile_start):  # noqa: ANN001, ANN201
    """Turns counts into places where the parts begin to write; fills `tile_start`; gives the sum."""
    total = 0
    for tile in range(per_tile.shape[1]):
        tile_start[tile] = total
        for chunk in range(CHUNKS):
            here = per_tile[chunk, tile]
            per_tile[chunk, tile] = total
            total += here
    tile_start[per_tile.shape[1]] = total
    return total


@kernel
def scatter(  # noqa: ANN201
    counter, visible, order, first_pair, pair_count, tiles, rows, per_tile, lists,  # noqa: ANN001
):  # fmt: skip
    """Fills lists [pairs, 2] of (splat, rows), tile after tile; tiles[pair] becomes the pair's place."""
    size = chunk_size(visible)
    while True:
        chunk = atomic_next(counter, 0)
        if chunk >= CHUNKS:
            return
        for rank in range(chunk * size, min(visible, (chunk + 1) * size)):
            splat = order[rank]
            first = first_pair[splat]
            for pair in range(first, first + pair_count[splat]):
                tile = tiles[pair]
                at = per_tile[chunk, tile]
                per_tile[chunk, tile] = at + 1
                lists[at, 0], lists[at, 1] = splat, rows[pair]
                tiles[pair] = at
