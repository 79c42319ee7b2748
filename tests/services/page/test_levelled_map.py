"""The packed map of a page: levels of detail, order of updates, memory limit."""

import itertools

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.mapfiles.detail import merge_by_cell
from beamsplat.common.messages.splat_codec import pack, unpack
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, SCALE
from beamsplat.services.page.map3d.levelled_map import LEVELS_M, LevelledMap

HUGE = 2**40


def gaussians(count, seed=0, side_m=2.0):
    """Return opaque Gaussians of 1 cm in a cube."""
    rng = np.random.default_rng(seed)
    params = np.zeros((14, count), np.float32)
    params[MEAN:SCALE] = rng.uniform(0.0, side_m, (3, count))
    params[SCALE : SCALE + 3] = np.log(0.01)
    params[6] = 1.0
    params[OPACITY] = 3.0
    params[COLOUR:] = rng.uniform(0.0, 1.0, (3, count))
    return params


def put(map_, anchor, params, revision=1, cell_m=0.0, T=None):
    map_.put(anchor, revision, np.eye(4) if T is None else T, cell_m, pack(params).tobytes())


def levels_of(map_, anchor):
    return next(chunk for chunk in map_.index() if chunk["anchor"] == anchor)


def fetched(map_, anchor, cell_m):
    entry = levels_of(map_, anchor)
    return unpack(np.frombuffer(map_.level(anchor, entry["revision"], cell_m), np.uint8))


def test_a_chunk_is_there_at_once_and_its_coarser_levels_follow_under_the_same_revision():
    map_, params = LevelledMap(HUGE), gaussians(20_000, side_m=1.0)
    put(map_, 7, params)
    first = levels_of(map_, 7)
    assert [level["cell_m"] for level in first["levels"]] == [0.0]
    assert np.allclose(first["low"], params[:3].min(axis=1), atol=1e-6)
    assert np.allclose(first["high"], params[:3].max(axis=1), atol=1e-6)
    before = map_.revision
    assert map_.make_levels(0.0)
    assert not map_.make_levels(0.0)
    assert map_.revision > before
    entry = levels_of(map_, 7)
    assert entry["revision"] == first["revision"]
    counts = [level["count"] for level in entry["levels"]]
    assert counts[0] == 20_000
    assert all(b <= 0.7 * a for a, b in itertools.pairwise(counts))
    assert {level["cell_m"] for level in entry["levels"][1:]} <= set(LEVELS_M)
    for level in entry["levels"]:
        assert len(map_.level(7, entry["revision"], level["cell_m"])) == level["bytes"]
    # A coarse level covers the same space with the same mean colour.
    coarse = fetched(map_, 7, entry["levels"][1]["cell_m"])
    assert np.abs(coarse[:3].mean(axis=1) - params[:3].mean(axis=1)).max() < 0.02
    assert np.abs(coarse[COLOUR:].mean(axis=1) - params[COLOUR:].mean(axis=1)).max() < 0.02
    assert coarse[:3].min() > -0.01
    assert coarse[:3].max() < 1.01


def test_merging_by_number_of_the_cell_is_merging_by_cell():
    params = gaussians(3000, side_m=0.5)
    params[:3] -= 0.25
    merged = merge_by_cell(params, 0.05)
    cells = np.unique(np.floor(params[:3].astype(np.float64) / 0.05), axis=1)
    assert merged.shape[1] == cells.shape[1]
    assert np.array_equal(np.unique(np.floor(merged[:3].astype(np.float64) / 0.05), axis=1), cells)
    params[0, 0] = 1e6  # more cells than a number has room for
    far = merge_by_cell(params, 0.05)
    assert far.shape[1] == np.unique(np.floor(params[:3].astype(np.float64) / 0.05), axis=1).shape[1]


def test_older_and_coarser_updates_are_ignored_and_no_gaussians_remove_a_chunk():
    map_ = LevelledMap(HUGE)
    put(map_, 1, gaussians(300), revision=5, cell_m=0.04)
    first = levels_of(map_, 1)["revision"]
    put(map_, 1, gaussians(400), revision=4)
    put(map_, 1, gaussians(400), revision=5, cell_m=0.08)
    map_.make_levels(0.0)
    assert levels_of(map_, 1)["levels"][0]["count"] == 300
    put(map_, 1, gaussians(500), revision=5, cell_m=0.02)
    assert map_.make_levels(10.0)
    entry = levels_of(map_, 1)
    assert entry["levels"][0]["count"] == 500
    assert entry["revision"] != first
    assert map_.level(1, first, 0.04) is None, "its bytes belong to the revision before"
    put(map_, 1, gaussians(0), revision=6)
    assert map_.index() == []
    with pytest.raises(ValueError, match="not packed Gaussians"):
        map_.put(1, 7, np.eye(4), 0.0, b"x" * 40)


def test_levels_of_a_chunk_are_made_once_a_second_at_most_and_of_its_newest_update():
    map_ = LevelledMap(HUGE)
    put(map_, 1, gaussians(300))
    assert map_.make_levels(100.0)
    for revision in range(2, 6):
        put(map_, 1, gaussians(300 + revision), revision)
        assert not map_.make_levels(100.5)
    assert map_.make_levels(101.0)
    assert levels_of(map_, 1)["levels"][0]["count"] == 305


def test_a_moved_anchor_keeps_its_bytes():
    map_, T = LevelledMap(HUGE), se2_to_se3(np.array([3.0, -1.0, 0.5]))
    put(map_, 1, gaussians(300))
    before, revision = levels_of(map_, 1), map_.revision
    map_.move({1: T, 2: T}, pose_revision=1)
    after = levels_of(map_, 1)
    assert np.allclose(np.reshape(after["T_map_anchor"], (4, 4)), T, atol=1e-6)
    assert (after["revision"], after["levels"]) == (before["revision"], before["levels"])
    assert map_.revision > revision
    revision = map_.revision
    map_.move({1: T}, pose_revision=1)
    assert map_.revision == revision
    map_.move({1: np.eye(4)}, pose_revision=0)  # from before: it arrives late
    assert levels_of(map_, 1) == after


def test_what_does_not_fit_is_kept_coarser_the_longest_unused_first():
    whole = LevelledMap(HUGE)
    for anchor in range(4):
        put(whole, anchor, gaussians(8000, anchor, side_m=0.6))
        whole.make_levels(0.0)
    size = sum(level["bytes"] for chunk in whole.index() for level in chunk["levels"])
    small = LevelledMap(int(0.8 * size))
    for anchor in range(4):
        put(small, anchor, gaussians(8000, anchor, side_m=0.6))
        small.make_levels(0.0)
        if anchor == 2:
            fetched(small, 0, 0.0)  # somebody looks at the first one
    kept = {chunk["anchor"]: [level["cell_m"] for level in chunk["levels"]] for chunk in small.index()}
    assert sum(level["bytes"] for chunk in small.index() for level in chunk["levels"]) <= 0.8 * size
    assert set(kept) == set(range(4)), "all are there"
    assert small.coarsened == sum(0.0 not in cells for cells in kept.values()) >= 1
    assert 0.0 not in kept[1]
    assert 0.0 in kept[0]
    assert small.left_out == 0
    tiny = LevelledMap(1000)
    put(tiny, 0, gaussians(8000))
    assert (tiny.index(), tiny.left_out) == ([], 1)


def test_another_producer_starts_another_map():
    map_ = LevelledMap(HUGE)
    map_.start_over("first")
    put(map_, 1, gaussians(300), revision=9)
    old = levels_of(map_, 1)["revision"]
    map_.start_over("second")
    assert map_.index() == []
    put(map_, 1, gaussians(400), revision=1)
    assert levels_of(map_, 1)["levels"][0]["count"] == 400
    assert map_.level(1, old, 0.0) is None
