"""The grid in tiles equals the grid in one piece, and its cost does not grow with the map."""

import dataclasses

import numpy as np
import pytest

from beamsplat.common.mapfiles.grid_tiles import TILE_CELLS, GridSource, TiledGrid
from beamsplat.common.topics import topic
from beamsplat.services.localization.lidar2d import grid_tiles
from beamsplat.services.localization.lidar2d.grid_tiles import GridTiles, MapContent
from beamsplat.services.localization.lidar2d.occupancy import CountGrid, render_occupancy
from tests.services.localization.test_resume import drive, make

RESOLUTION_M = 0.05
SIDE = 300  # cells of a submap: 15 m


def submap(seed):
    """Return the counts of a square room with a wall of hits."""
    rng = np.random.default_rng(seed)
    hits, misses = np.zeros((SIDE, SIDE), np.uint8), rng.integers(0, 9, (SIDE, SIDE)).astype(np.uint8)
    hits[[5, -6], 5:-5] = hits[5:-5, [5, -6]] = 40
    return CountGrid(hits, misses, -SIDE // 2, -SIDE // 2, RESOLUTION_M)


ROOMS = [submap(seed) for seed in range(4)]


def corridor(count, spacing_m=10.0, shift_m=0.0):
    """Return submaps in a row along x, with their poses; the last is still growing."""
    poses = [np.array([i * spacing_m, shift_m * i, 0.1 * i]) for i in range(count)]
    finished = [(i, ROOMS[i % 4], pose) for i, pose in enumerate(poses[:-1])]
    return MapContent(finished, [(ROOMS[(count - 1) % 4], poses[-1])])


def assembled(tiles, like):
    """Return the tiles as one grid on the cells of the grid `like`."""
    grid = TiledGrid()
    for place, packed in tiles.items():
        grid.add(GridSource("", 0, RESOLUTION_M, TILE_CELLS), *place, packed)
    whole, origin = grid.assembled(), np.round(grid.origin_m() / RESOLUTION_M).astype(int)
    top = round(like.origin_y_m / RESOLUTION_M) - origin[1]
    left = round(like.origin_x_m / RESOLUTION_M) - origin[0]
    rows, columns = like.values.shape
    padded = np.pad(whole, 2 * TILE_CELLS, constant_values=-1)
    top, left = top + 2 * TILE_CELLS, left + 2 * TILE_CELLS
    return padded[top : top + rows, left : left + columns]


def whole_grid(content):
    return render_occupancy([*((f, p) for _, f, p in content.finished), *content.growing], RESOLUTION_M)


def test_tiles_follow_a_map_that_grows_moves_and_loses_submaps():
    tiles = GridTiles(RESOLUTION_M)
    received = {}
    moved = corridor(6, shift_m=0.7)
    steps = [corridor(n) for n in range(1, 7)] + [
        moved,
        dataclasses.replace(moved, finished=moved.finished[2:]),
    ]
    for content in steps:
        received |= tiles.update(content)
        assert tiles.pending == 0
        expected = whole_grid(content)
        np.testing.assert_array_equal(assembled(received, expected), expected.values)
        assert {place for place, packed in received.items() if packed} == set(tiles.published)
    assert any(packed == b"" for packed in received.values())  # tiles that the removed submaps have left


def test_what_does_not_change_is_neither_drawn_nor_published():
    tiles = GridTiles(RESOLUTION_M)
    content = corridor(6)
    tiles.update(content)
    before = dataclasses.replace(tiles.work)
    assert tiles.update(content) == {}
    assert tiles.work.submaps == before.submaps
    assert tiles.work.tiles - before.tiles <= 4  # those of the growing submap
    jitter = [(i, f, pose + 0.001) for i, f, pose in content.finished]  # as of every optimisation
    assert tiles.update(dataclasses.replace(content, finished=jitter)) == {}
    assert tiles.work.submaps == before.submaps
    exact = tiles.update(dataclasses.replace(content, finished=jitter), exact=True)
    expected = whole_grid(dataclasses.replace(content, finished=jitter))
    assert exact
    np.testing.assert_array_equal(assembled(tiles.published, expected), expected.values)


def test_the_work_of_an_update_is_the_same_for_a_small_and_a_large_map():
    tiles = GridTiles(RESOLUTION_M)
    work = []
    for count in range(1, 61):
        before = dataclasses.replace(tiles.work)
        tiles.update(corridor(count))
        after = tiles.work
        work.append((after.tiles - before.tiles, after.submaps - before.submaps, after.cells - before.cells))
    first, last = np.array(work[5:20]).max(axis=0), np.array(work[-20:]).max(axis=0)
    assert (last <= 1.05 * first).all(), (first, last)
    assert last[1] <= 8
    assert len(tiles.published) > 30


def test_a_loop_closure_is_drawn_in_bounded_portions_the_oldest_change_first(monkeypatch):
    monkeypatch.setattr(grid_tiles, "TILES_PER_UPDATE", 7)
    tiles = GridTiles(RESOLUTION_M)
    while tiles.update(corridor(60)) or tiles.pending:
        pass
    moved = corridor(60, shift_m=0.3)
    expected, updates = whole_grid(moved), 0
    while not updates or tiles.pending > 9:  # the tiles of the growing submap are always due
        before = tiles.work.tiles
        tiles.update(moved)
        assert tiles.work.tiles - before <= 7
        updates += 1
    assert updates >= 5
    while tiles.update(moved):
        pass
    np.testing.assert_array_equal(assembled(tiles.published, expected), expected.values)


def sent_tiles(tiles, content, updates):
    """Return the numbers of tiles sent in the updates, and all packed tiles in order."""
    counts, sent = [], []
    for _ in range(updates):
        update = tiles.to_send(tiles.update(content))
        counts.append(len(update))
        sent += update.items()
    return counts, sent


def test_at_rest_one_tile_in_half_a_minute_is_sent():
    tiles = GridTiles(RESOLUTION_M)
    counts, sent = sent_tiles(tiles, corridor(6), 4)
    assert set(dict(sent)) == set(tiles.published)
    assert counts[1:] == [0, 0, 0]
    counts, sent = sent_tiles(tiles, corridor(6), 60)  # five minutes
    assert sum(counts) == 10
    assert dict(sent).items() <= tiles.published.items()
    assert len(dict(sent)) == len(tiles.published)  # each in its turn: what was lost is healed


def test_a_tile_is_sent_again_before_it_leaves_the_cache(monkeypatch):
    monkeypatch.setattr(grid_tiles, "_RESEND_AFTER", 20)
    tiles, sent, first = GridTiles(RESOLUTION_M), [], corridor(2)
    sent_tiles(tiles, first, 1)
    old = set(tiles.published)
    for count in range(3, 60):
        _, more = sent_tiles(tiles, corridor(count), 1)
        sent += more
        assert old <= {place for place, _ in sent[-200:]} or len(sent) < 40
    assert len(sent) > 300
    assert dict(sent[-200:]) == tiles.published


def test_noise_on_counts_is_not_published_before_the_end():
    tiles, growing = GridTiles(RESOLUTION_M), ROOMS[0]
    content = MapContent([], [(growing, np.zeros(3))])
    tiles.update(content)
    hits = growing.hits.copy()
    hits[hits > 0] += 1  # a further scan of the same walls, at rest
    misses = np.where(growing.misses >= 8, growing.misses + 1, growing.misses).astype(np.uint8)
    again = MapContent([], [(dataclasses.replace(growing, hits=hits, misses=misses), np.zeros(3))])
    assert tiles.update(again) == {}
    exact = tiles.update(again, exact=True)
    np.testing.assert_array_equal(assembled(tiles.published, whole_grid(again)), whole_grid(again).values)
    assert exact.keys() <= tiles.published.keys()
    hits[100:110, 100] = 40  # an obstacle
    seen = MapContent([], [(dataclasses.replace(growing, hits=hits, misses=misses), np.zeros(3))])
    assert len(tiles.update(seen)) == 1


@pytest.mark.parametrize("count", [1, 3])
def test_bands_of_a_large_grid_fit_together(monkeypatch, count):
    content = corridor(count)
    expected = whole_grid(content)
    monkeypatch.setattr("beamsplat.services.localization.lidar2d.occupancy._BAND_CELLS", 40_000)
    np.testing.assert_array_equal(whole_grid(content).values, expected.values)


def received(messages):
    grid = TiledGrid()
    for m in messages:
        grid.add(
            GridSource(m.map_uuid, m.since_ns, m.resolution_m, m.size), m.row, m.column, m.packed.tobytes()
        )
    return grid


def test_a_subscriber_of_the_node_has_the_map_at_the_end_also_if_it_joined_late():
    node = make(grid_every_scans=10)
    sent, _ = drive(node, 0.0, 9.0, 1, 0)
    messages = sent["localization/grid"]
    updates = np.flatnonzero([m.remaining == 0 for m in messages])
    assert len(updates) >= 8
    sizes = np.diff([-1, *updates])
    assert [m.remaining for m in messages] == [left for n in sizes for left in range(n - 1, -1, -1)]
    whole = node._slam.grid(RESOLUTION_M)
    cached = messages[-topic("localization/grid").cache :]  # what a subscriber that joins at the end receives
    for heard in (messages, cached):
        np.testing.assert_array_equal(assembled(received(heard).tiles, whole), whole.values)
    assert (whole.values >= 65).sum() > 300  # walls
    again, _ = drive(make(grid_every_scans=10), 0.0, 2.0, 2, 1)  # a restarted process with another map
    grid = received([*messages, *again["localization/grid"]])
    assert grid.tiles == received(again["localization/grid"]).tiles
