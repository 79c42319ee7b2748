"""Tiles of the grid: packing, assembly, removal, damage, and limits."""

import zlib

import numpy as np
import pytest

from beamsplat.common.mapfiles.grid_tiles import GridSource, TiledGrid, pack_tile, unpack_tile

SOURCE = GridSource("a", 7, 0.05, 16)


def cells(seed, size=16):
    return np.random.default_rng(seed).integers(-1, 101, (size, size)).astype(np.int8)


def test_tiles_are_assembled_at_their_places():
    grid = TiledGrid()
    grid.add(SOURCE, -1, 2, pack_tile(cells(0)))
    grid.add(SOURCE, 1, 0, pack_tile(cells(1)))
    whole = grid.assembled()
    assert whole.shape == (48, 48)
    np.testing.assert_array_equal(whole[:16, 32:], cells(0))
    np.testing.assert_array_equal(whole[32:, :16], cells(1))
    assert (whole[16:32] == -1).all()
    np.testing.assert_allclose(grid.origin_m(), [0.0, -0.8])
    assert (grid.assembled(stride=4)[:4, 8:] == cells(0).reshape(4, 4, 4, 4).max(axis=(1, 3))).all()
    assert grid.stride_for(48) == 1
    assert grid.stride_for(20) == 4


def test_an_empty_tile_removes_and_another_process_replaces_all():
    grid = TiledGrid()
    assert grid.add(SOURCE, 0, 0, pack_tile(cells(0)))
    assert not grid.add(SOURCE, 0, 1, pack_tile(cells(1)))
    before = grid.copy()
    assert pack_tile(np.full((16, 16), -1, np.int8)) == b""
    grid.add(SOURCE, 0, 0, b"")
    assert grid.bounds() == (0, 1, 1, 2)
    restarted = GridSource("a", 8, 0.05, 16)
    assert grid.add(restarted, 5, 5, pack_tile(cells(2)))
    assert list(grid.tiles) == [(5, 5)]
    assert list(before.tiles) == [(0, 0), (0, 1)]


def test_damaged_tiles_are_refused_and_change_nothing():
    grid = TiledGrid(max_tiles=2)
    grid.add(SOURCE, 0, 0, pack_tile(cells(0)))
    bomb = zlib.compress(bytes(10_000_000))
    for packed in (b"abc", pack_tile(cells(0, 8)), pack_tile(cells(0, 17)), bomb, pack_tile(cells(1))[:-9]):
        with pytest.raises(ValueError, match="grid tile"):
            grid.add(GridSource("other", 0, 0.05, 16), 1, 1, packed)
    assert grid.source == SOURCE
    np.testing.assert_array_equal(grid.assembled(), cells(0))
    grid.add(SOURCE, 9, 9, pack_tile(cells(1)))
    with pytest.raises(ValueError, match="more than 2 tiles"):
        grid.add(SOURCE, 2, 2, pack_tile(cells(2)))
    with pytest.raises(ValueError, match="160 x 160 cells, more than 1000"):
        grid.assembled(max_cells=1000)
    assert (unpack_tile(b"", 16) == -1).all()
    grid.add(SOURCE, 9, 9, zlib.compress(bytes([200] * 256)))  # no cell is known: all are negative
    assert list(grid.tiles) == [(0, 0)]
