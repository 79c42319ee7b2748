"""Each kernel against its slow twin, or against what it must do by definition."""

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import make_transform, so3_exp
from beamsplat.services.fusion import upsample
from beamsplat.services.fusion import volume_kernels as fast
from beamsplat.services.fusion import volume_reference as slow
from beamsplat.services.fusion.keyframe_depth import KeyframeDepths, median_vote
from beamsplat.services.fusion.lidar_map import LidarMap


@pytest.fixture(scope="module")
def volume():
    rng = np.random.default_rng(0)
    h, w, D, S = 9, 12, 10, 6
    args = (
        rng.normal(size=(h, w, 3)).astype(np.float32),
        rng.normal(size=(S, h, w, 3)).astype(np.float32),
        np.array([so3_exp(rng.normal(0, 0.1, 3)) for _ in range(S)], np.float32),
        rng.normal(0, 0.3, (S, 3)).astype(np.float32),
        np.array([10.0, 10.0, 5.5, 4.0], np.float32),
        np.geomspace(0.5, 8.0, D).astype(np.float32),
        rng.uniform(1.0, 12.0, (h, w)).astype(np.float32),
    )
    return args


def test_cost_volume_is_its_twin(volume):
    out = np.empty((9, 12, 10), np.float32)
    fast.cost_volume(*volume, 2.0, out)
    assert np.allclose(out, slow.cost_volume(*volume, 2.0), atol=2e-4)
    assert out.std() > 0.05


def test_box_and_aggregation_are_their_twins():
    rng = np.random.default_rng(1)
    cost = rng.uniform(0, 5, (7, 8, 6)).astype(np.float32)
    guide = rng.uniform(0, 60, (7, 8)).astype(np.float32)
    out = np.empty_like(cost)
    fast.box3(cost, 3.0, out)
    assert np.allclose(out, slow.box3(cost, 3.0), atol=1e-5)
    for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        total = np.zeros_like(cost)
        fast.aggregate(cost, guide, dv, du, 0.5, 4.0, 8.0, total)
        assert np.allclose(total, slow.aggregate(cost, guide, dv, du, 0.5, 4.0, 8.0), atol=1e-4)


def test_a_prior_makes_the_label_at_its_depth_cheapest():
    log_z = np.linspace(np.log(0.5), np.log(8.0), 40)
    cost = np.zeros((2, 3, 40), np.float32)
    z = np.array([[1.0, np.nan, 3.0], [0.01, 100.0, 2.0]], np.float32)
    fast.add_prior(cost, z, np.full((2, 3), 2.0, np.float32), log_z[0], log_z[1] - log_z[0], 1.0)
    depth, spread = np.empty((2, 3), np.float32), np.empty((2, 3), np.float32)
    fast.winner_takes_all(cost, log_z, 0.2, depth, spread)
    for v, u in ((0, 0), (0, 2), (1, 2)):
        assert depth[v, u] == pytest.approx(z[v, u], rel=0.02)
        assert spread[v, u] < 0.2
    for v, u in ((0, 1), (1, 0), (1, 1)):
        assert not cost[v, u].any()
        assert spread[v, u] > 0.5


def test_a_plane_overhead_gains_where_its_labels_are_cheap():
    log_z = np.linspace(np.log(0.5), np.log(10.0), 60)
    rise = np.repeat(np.linspace(0.5, 0.28, 10)[:, None], 8, axis=1)
    plane = (2.4 - 0.45) / rise
    cost = np.full((10, 8, 60), 5.0, np.float32)
    step = log_z[1] - log_z[0]
    for v in range(10):
        cost[v, :, round((np.log(plane[v, 0]) - log_z[0]) / step)] = 1.0
    heights = np.arange(1.6, 3.2, 0.1)
    gain = np.zeros(len(heights))
    fast.plane_gain(cost, rise, np.full((10, 8), 9.0), 0.45, log_z[0], step, heights, gain)
    assert heights[np.argmax(gain)] == pytest.approx(2.4, abs=0.11)
    assert gain.max() > 100.0


def test_depth_carried_into_another_view_lies_where_the_points_are():
    K = np.array([130.0, 130.0, 79.5, 59.5])
    v, u = np.mgrid[:120, :160].astype(float)
    normal, offset = np.array([0.1, -0.2, 1.0]), 3.0

    def plane_in(T_map_camera):
        rays = (
            np.stack([(u - K[2]) / K[0], (v - K[3]) / K[1], np.ones_like(u)], axis=-1)
            @ T_map_camera[:3, :3].T
        )
        return (offset - T_map_camera[:3, 3] @ normal) / (rays @ normal)

    memory = KeyframeDepths(K, (120, 160), 3)
    for x in (0.0, 0.1, 0.2):
        T = make_transform(so3_exp(np.array([0.0, 0.05 * x, 0.0])), np.array([x, 0.0, x]))
        memory.add(T, plane_in(T).astype(np.float32))
    now = make_transform(so3_exp(np.array([0.01, 0.03, 0.0])), np.array([0.25, 0.02, 0.3]))
    remembered = memory.warp_into(now)
    truth = plane_in(now)
    seen = remembered.votes == 3
    assert seen.mean() > 0.8
    assert np.quantile(np.abs(remembered.depth_m[seen] / truth[seen] - 1.0), 0.99) < 0.015


def test_the_median_of_keyframes_outvotes_one_that_errs():
    carried = np.array([2.0, 2.02, np.nan, 5.0], np.float32).reshape(4, 1, 1)
    depth, votes = np.full((1, 1), np.nan, np.float32), np.zeros((1, 1), np.int64)
    median_vote(carried, 0.06, depth, votes)
    assert depth[0, 0] == pytest.approx(2.02)
    assert votes[0, 0] == 2


def test_walls_behind_walls_are_found_where_they_stand():
    lidar_map = LidarMap()
    y = np.linspace(-2, 2, 400)
    rng = np.random.default_rng(0)
    for x in (2.0, 3.5):
        for _ in range(4):
            lidar_map.add(np.column_stack([x + rng.normal(0, 0.01, 400), y, np.zeros(400)]))
    lidar_map.add(np.array([[-30.0, 40.0, 0.0]]))  # the grid grows
    azimuth = np.linspace(-0.4, 0.4, 21)
    ranges = lidar_map.layers(np.array([0.5, 0.1]), azimuth)
    assert np.nanmax(np.abs(ranges[0] * np.cos(azimuth) - 1.5)) < 0.03
    assert np.nanmax(np.abs(ranges[1] * np.cos(azimuth) - 3.0)) < 0.04
    assert np.isnan(ranges[2]).all()


def test_enlarging_is_exact_on_planes_and_keeps_edges_with_the_colour():
    v, u = np.mgrid[:480, :640].astype(float)
    plane = (1.0 / (0.5 - 0.0004 * u + 0.0003 * v)).astype(np.float32)
    small = (1.0 / (0.5 - 0.0004 * (4 * u[:120, :160] + 1.5) + 0.0003 * (4 * v[:120, :160] + 1.5))).astype(
        np.float32
    )
    grey = np.full((480, 640, 3), 90, np.uint8)
    depth, sigma = np.empty((480, 640), np.float32), np.empty((480, 640), np.float32)
    upsample.upsample_depth(small, np.full_like(small, 0.01), grey[::4, ::4].copy(), grey, 0.08, depth, sigma)
    inner = (slice(2, -2), slice(2, -2))
    assert np.allclose(depth[inner], plane[inner], rtol=1e-4)
    assert np.allclose(sigma[inner], 0.01 * depth[inner], rtol=1e-3)
    step = np.where(np.arange(160) < 80, 1.0, 3.0)[None].repeat(120, 0).astype(np.float32)
    colours = np.zeros((480, 640, 3), np.uint8)
    colours[:, 321:] = 200
    upsample.upsample_depth(
        step, np.full_like(step, 0.01), np.ascontiguousarray(colours[1::4, 1::4]), colours, 0.08, depth, sigma
    )
    assert np.all(depth[:, 318:321] == 1.0)
    assert np.all(depth[:, 321:323] == 3.0)
    step[:, 100:] = np.nan
    upsample.upsample_depth(
        step, np.full_like(step, 0.01), np.ascontiguousarray(colours[1::4, 1::4]), colours, 0.08, depth, sigma
    )
    assert np.isnan(depth[:, 410:]).all()
