"""Pairs, clustering, and the one-number corrections."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamsplat.services.fusion.metric_estimate import metric_estimate
from beamsplat.services.fusion.pairs import effective_count, largest_cluster, make_pairs
from beamsplat.services.fusion.scaling import affine, ratio

SHAPE = (48, 64)


def _scene(rng, count=60):
    """Depth [48, 64] that varies smoothly, and beams on one row."""
    v, u = np.mgrid[:48, :64]
    depth = (2.0 + 0.02 * u + 0.01 * v).astype(np.float32)
    uv = np.column_stack([np.linspace(2, 61, count), np.full(count, 30.0)])
    z = depth[30, np.rint(uv[:, 0]).astype(int)].astype(float)
    return depth, uv, z + rng.normal(0, 0.01, count)


@given(st.lists(st.integers(-300, 300), max_size=60), st.integers(1, 50))
def test_the_cluster_is_that_of_dbscan_done_the_slow_way(values, radius):
    x, radius = np.array(values) / 100.0, (radius + 0.5) / 100.0  # no value lies exactly on the rim
    close = np.abs(x[:, None] - x[None]) <= radius
    core = close.sum(1) >= 4
    label = -np.ones(len(x), int)
    for start in np.flatnonzero(core):
        if label[start] >= 0:
            continue
        todo, label[start] = [start], start
        while todo:
            for j in np.flatnonzero(close[todo.pop()] & core):
                if label[j] < 0:
                    label[j] = start
                    todo.append(j)
    best = max((int((close[:, label == k].any(1)).sum()) for k in set(label[label >= 0])), default=0)
    found = largest_cluster(x, radius)
    assert found.sum() == best


def test_the_papers_ratio_is_the_quotient_of_sums():
    depth, uv, z = _scene(np.random.default_rng(0))
    result = ratio(depth / 1.7, "metric", uv, z)
    assert result.ok
    assert result.scale == pytest.approx(1.7, rel=0.003)
    assert abs(result.scale - 1.7) < 4 * result.scale_sigma
    assert result.inlier_share == 1.0
    assert np.nanmedian(np.abs(result.depth_m - depth)) < 0.01


def test_beams_on_something_the_network_does_not_see_are_dropped():
    depth, uv, z = _scene(np.random.default_rng(1))
    z[:18] = 0.4  # a chair leg
    result = ratio(depth / 2.0, "metric", uv, z)
    assert result.scale == pytest.approx(2.0, rel=0.01)
    assert result.inlier_share == pytest.approx(0.7, abs=0.05)


def test_affine_disparity_needs_its_shift():
    rng = np.random.default_rng(2)
    depth, uv, z = _scene(rng)
    disparity = ((1.0 / depth - 0.05) * 8.0).astype(np.float32)
    z[::9] = 0.5
    fitted = affine(disparity, "disparity", uv, z)
    assert fitted.ok
    assert np.median(np.abs(fitted.depth_m - depth)) < 0.02
    assert np.median(np.abs(ratio(disparity, "disparity", uv, z).depth_m - depth)) > 0.05


def test_nearer_and_farther_swapped_is_refused():
    depth, uv, z = _scene(np.random.default_rng(3))
    assert "nearer" in affine((1.0 / depth).astype(np.float32), "metric", uv, z).status


@pytest.mark.parametrize("beams", [0, 5])
def test_too_few_beams_give_a_sentence_and_no_depth(beams):
    depth, uv, z = _scene(np.random.default_rng(4))
    for method in (ratio, affine):
        result = method(depth, "metric", uv[:beams], z[:beams])
        assert "beams" in result.status
        assert np.isnan(result.depth_m).all()


def test_pairs_at_depth_jumps_and_unknown_pixels_are_left_out():
    depth = np.full(SHAPE, 2.0, np.float32)
    depth[:, 32:] = 4.0
    depth[:, :5] = np.nan
    uv = np.column_stack([np.arange(64.0), np.full(64, 20.0)])
    u = make_pairs(depth, uv, np.full(64, 2.0)).uv_px[:, 0]
    assert not np.isin(np.arange(30, 34), u).any()
    assert u.min() == 5
    assert 50 in u


def test_beams_that_err_together_count_as_few():
    rng = np.random.default_rng(5)
    alone = effective_count(rng.normal(size=400))
    together = effective_count(np.repeat(rng.normal(size=40), 10))
    assert alone > 300
    assert together < 80


def test_the_guess_is_corrected_by_columns_and_its_spread_is_that_of_beams_left_out():
    depth, uv, z = _scene(np.random.default_rng(6))
    bent = (depth * np.linspace(0.6, 1.4, 64)[None]).astype(np.float32)
    estimate = metric_estimate(bent, "metric", uv, z)
    assert np.median(np.abs(estimate.depth_m / depth - 1.0)) < 0.05
    assert estimate.spread < 0.1
    rubbish = np.exp(np.random.default_rng(7).normal(0, 0.5, SHAPE)).astype(np.float32)
    loose = metric_estimate(rubbish, "metric", uv, z)
    assert loose is None or loose.spread > 0.1
