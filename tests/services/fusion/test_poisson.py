"""The Poisson completion: its solver against dense algebra, its sigma, and depth in metres against truth."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.services.fusion import poisson_kernels
from beamsplat.services.fusion.fuse import Fusion
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.fusion.node import FusionConfig, FusionNode
from beamsplat.services.fusion.poisson import complete, difference_sigma, estimate_at_size, solve
from tests.services.fusion.room import CAMERA, T_BODY_CAMERA, in_map, render, scan

H, W, EDGE = 60, 80, 40  # the surface at the left of column EDGE is nearer


def _matrix(weight, right, down):
    """The dense matrix of the equation, float64 [h w, h w]."""
    h, w = weight.shape
    A = np.diag(weight.ravel()).astype(float)
    for i in range(h):
        for j in range(w):
            for p, q, c in (
                (i * w + j, i * w + j + 1, right[i, j] if j < w - 1 else 0.0),
                (i * w + j, (i + 1) * w + j, down[i, j] if i < h - 1 else 0.0),
            ):
                if c > 0.0:
                    A[[p, q], [p, q]] += c
                    A[[p, q], [q, p]] -= c
    return A


@st.composite
def _grids(draw):
    """(weight, right, down): a connected grid with a few measurements and conductances over six decades."""
    h, w = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    weight = np.where(rng.random((h, w)) < 0.15, 10.0 ** rng.uniform(0, 5, (h, w)), 0.0)
    weight[rng.integers(h), rng.integers(w)] = 10.0 ** rng.uniform(0, 5)
    return weight, 10.0 ** rng.uniform(-1, 5, (h, w)), 10.0 ** rng.uniform(-1, 5, (h, w))


@given(_grids())
def test_the_solution_is_that_of_dense_algebra(grid):
    weight, right, down = grid
    datum = np.random.default_rng(1).normal(size=weight.shape)
    expected = np.linalg.solve(_matrix(*grid), (weight * datum).ravel()).reshape(weight.shape)
    found = solve(
        weight, weight * datum, right, down, start=np.zeros_like(weight), tolerance=1e-12, iterations=500
    )
    np.testing.assert_allclose(found, expected, atol=1e-6)


@given(_grids())
def test_the_path_variance_is_a_bound_of_the_exact_variance(grid):
    """Rayleigh: a single path is no better conductor than the whole network."""
    weight, right, down = grid
    exact = np.diag(np.linalg.inv(_matrix(*grid))).reshape(weight.shape)
    bound = np.where(weight > 0.0, 1.0 / np.maximum(weight, 1e-300), np.inf)
    across, along = 1.0 / right, 1.0 / down
    across[:, -1], along[-1] = np.inf, np.inf
    poisson_kernels.path_variance(bound, across, along, 200)
    assert np.all(bound >= exact * (1.0 - 1e-6))


def test_on_a_chain_with_one_measurement_the_path_variance_is_exact():
    weight, right, down = np.zeros((1, 30)), np.linspace(1.0, 9.0, 30)[None], np.zeros((1, 30))
    weight[0, 7] = 4.0
    bound = np.where(weight > 0.0, 1.0 / np.maximum(weight, 1e-300), np.inf)
    poisson_kernels.path_variance(bound, 1.0 / right, np.full((1, 30), np.inf), 50)
    np.testing.assert_allclose(bound[0], np.diag(np.linalg.inv(_matrix(weight, right, down))), rtol=1e-9)


def test_few_steps_solve_the_size_of_a_keyframe():
    """120 x 160 pixels, measurements on one row only, conductances with an edge: the work is bounded."""
    weight, right, down = np.zeros((120, 160)), np.full((120, 160), 4e3), np.full((120, 160), 4e3)
    weight[70] = 1e4
    right[:, 79] = 1.0
    datum = np.zeros((120, 160))
    datum[70, 80:] = 1.0
    y = solve(weight, weight * datum, right, down, start=np.zeros((120, 160)))
    expected = solve(
        weight, weight * datum, right, down, start=np.zeros((120, 160)), tolerance=1e-10, iterations=500
    )
    assert np.abs(y - expected).max() < 0.01
    assert np.abs(y[:, :79]).max() < 0.1
    assert np.abs(y[:, 81:] - 1.0).max() < 0.1


def _scene():
    """True depth (m): a wall that recedes to the right, in front of another one that rises from the floor."""
    v, u = np.mgrid[:H, :W].astype(float)
    return np.where(u < EDGE, 1.5 + 0.02 * u, 3.5 + 0.01 * v + 0.005 * u)


def _measurements(truth, rng, wrong=0.0):
    """Beams on one row (1 cm), and every tenth pixel by a plane sweep (4 %), of which `wrong` are gross errors."""
    sigma = np.full(truth.shape, np.nan, np.float32)
    sigma[rng.random(truth.shape) < 0.1] = 0.04
    sigma[35] = 0.005
    measured = (truth * np.exp(np.nan_to_num(sigma) * rng.normal(size=truth.shape))).astype(np.float32)
    gross = (rng.random(truth.shape) < wrong) & (sigma > 0.01)
    measured[gross] *= 1.6
    measured[~np.isfinite(sigma)] = np.nan
    return measured, sigma


def _estimate(truth, kind):
    """The true shape with a scale and a shift for each surface, which nobody knows."""
    u = np.arange(W)[None].repeat(H, 0)
    if kind == "disparity":
        return np.where(u < EDGE, 3.0 / truth + 0.4, 2.2 / truth + 0.9).astype(np.float32)
    return np.where(u < EDGE, 0.5 * truth + 0.1, 0.8 * truth - 0.4).astype(np.float32)


@pytest.mark.parametrize("kind", ["relative", "disparity"])
@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_each_surface_gets_its_own_scale_and_shift(kind, wrong):
    """Centimetres from measurements of 1 and of 10 cm; where they are wrong, they are outvoted."""
    truth = _scene()
    measured, sigma = _measurements(truth, np.random.default_rng(3), wrong)
    done = complete(_estimate(truth, kind), kind, measured, sigma)
    error = np.abs(done.depth_m - truth)
    assert np.isfinite(done.depth_m).all()
    assert np.median(error) < 0.05
    assert np.mean(error) < 0.08
    one_factor = _estimate(truth, kind) if kind == "relative" else 1.0 / _estimate(truth, kind)
    one_factor = one_factor * np.nanmedian(measured / one_factor)
    assert np.mean(error) < 0.3 * np.mean(np.abs(one_factor - truth))


def test_sigma_tells_the_error():
    inside, threefold, near, far = [], [], [], []
    for seed in range(4):
        truth = _scene()
        measured, sigma = _measurements(truth, np.random.default_rng(seed))
        done = complete(_estimate(truth, "relative"), "relative", measured, sigma)
        pull = np.abs(done.depth_m - truth) / (done.sigma_log * done.depth_m)
        inside.append(np.mean(pull < 1.0))
        threefold.append(np.mean(pull < 3.0))
        near.append(np.median(done.sigma_log[34]))
        far.append(np.median(done.sigma_log[5]))
    assert np.mean(inside) > 0.65
    assert np.mean(threefold) > 0.97
    assert np.mean(near) < 0.5 * np.mean(far)


def test_an_edge_of_the_estimate_stays_an_edge():
    truth = _scene()
    measured, sigma = _measurements(truth, np.random.default_rng(5))
    done = complete(_estimate(truth, "relative"), "relative", measured, sigma).depth_m
    assert np.abs(np.log(done[:, EDGE - 1] / truth[:, EDGE - 1])).max() < 0.08
    assert np.abs(np.log(done[:, EDGE] / truth[:, EDGE])).max() < 0.08


def test_an_edge_that_the_estimate_lacks_is_blurred_over_its_neighbourhood_only():
    """A flat estimate, which does not see the nearer surface."""
    truth = _scene()
    rng = np.random.default_rng(6)
    sigma = np.full(truth.shape, 0.03, np.float32)
    measured = (truth * np.exp(0.03 * rng.normal(size=truth.shape))).astype(np.float32)
    done = complete(np.full(truth.shape, 2.0, np.float32), "metric", measured, sigma).depth_m
    for column in (EDGE - 25, EDGE + 24):
        assert np.median(np.abs(done[:, column] / truth[:, column] - 1.0)) < 0.05


def test_beams_and_floor_are_not_changed():
    truth = _scene()
    measured, sigma = _measurements(truth, np.random.default_rng(7))
    done = complete(_estimate(truth, "relative"), "relative", measured, sigma)
    np.testing.assert_array_equal(done.depth_m[35], measured[35])
    np.testing.assert_array_equal(done.sigma_log[35], sigma[35])


def test_pixels_without_an_estimate_keep_their_measurement_and_islands_stay_unknown():
    truth = _scene()
    measured, sigma = _measurements(truth, np.random.default_rng(8))
    estimate = _estimate(truth, "relative")
    estimate[:, 60:] = np.nan  # outside the network's view
    measured[:20, :20], sigma[:20, :20] = np.nan, np.nan
    estimate[10, :20], estimate[:20, 19], estimate[:11, 19] = np.nan, np.nan, np.nan  # an island: rows 0 to 9
    done = complete(estimate, "relative", measured, sigma)
    outside = (slice(None), slice(60, None))
    np.testing.assert_array_equal(done.depth_m[outside], measured[outside])
    np.testing.assert_array_equal(done.sigma_log[outside], sigma[outside])
    assert np.isnan(done.depth_m[:10, :19]).all()
    assert np.isnan(done.sigma_log[:10, :19]).all()
    assert np.isfinite(done.depth_m[20:, :60]).all()


@pytest.mark.parametrize("kind", ["metric", "disparity"])
def test_nothing_to_complete_is_said_so(kind):
    truth = _scene()
    measured, sigma = _measurements(truth, np.random.default_rng(9))
    unknown = np.full(truth.shape, np.nan, np.float32)
    assert complete(unknown, kind, measured, sigma) is None
    assert complete(_estimate(truth, kind), kind, unknown, unknown) is None
    few = np.where(np.arange(truth.size).reshape(truth.shape) < 8, 2.0, np.nan).astype(np.float32)
    assert complete(_estimate(truth, kind), kind, few, 0.02 * few) is None


def test_a_disparity_with_near_and_far_swapped_is_not_used():
    truth = _scene()
    measured, sigma = _measurements(truth, np.random.default_rng(10))
    assert complete(truth.astype(np.float32), "disparity", measured, sigma) is None


@settings(max_examples=25)
@given(st.floats(0.05, 20.0), st.integers(0, 1000))
def test_the_unit_of_a_relative_estimate_has_no_effect(unit, seed):
    truth = _scene()
    measured, sigma = _measurements(truth, np.random.default_rng(seed))
    first = complete(_estimate(truth, "relative"), "relative", measured, sigma).depth_m
    other = complete(
        (unit * _estimate(truth, "relative")).astype(np.float32), "relative", measured, sigma
    ).depth_m
    np.testing.assert_allclose(first, other, rtol=2e-3)


def test_the_error_of_differences_is_measured_in_the_image():
    """A random walk of known step along the rows; a smooth drift counts by its change over the longest lag."""
    rng = np.random.default_rng(1)
    limits = (0.004, 0.02, 0.06)
    walk = np.full((120, 160), np.nan)
    walk[::10] = np.cumsum(rng.normal(0.0, 0.03, (12, 160)), axis=1)
    assert difference_sigma(walk, limits) == pytest.approx(0.03, rel=0.25)
    drift = np.broadcast_to(0.004 * np.arange(160.0), (120, 160))
    assert difference_sigma(drift, limits) == pytest.approx(1.4826 * 0.004 * 16 / np.sqrt(16))
    assert difference_sigma(np.zeros((120, 160)), limits) == 0.004
    assert difference_sigma(100.0 * walk, limits) == 0.06
    assert difference_sigma(np.full((120, 160), np.nan), limits) == 0.02


def test_an_estimate_that_was_made_from_the_measurements_is_not_used():
    """As that of the source `stixel`: its agreement with beams and floor says nothing about other surfaces."""
    truth = _scene()
    measured, sigma = _measurements(truth, np.random.default_rng(11))
    assert (
        complete(np.where(sigma < 0.01, measured, 3.0).astype(np.float32), "metric", measured, sigma) is None
    )


def test_an_estimate_is_averaged_to_the_working_size():
    full = np.exp(np.random.default_rng(2).normal(size=(480, 640))).astype(np.float32)
    full[:8, :8] = np.nan
    small = estimate_at_size(full, "metric", 160, 120)
    assert small.shape == (120, 160)
    assert np.isnan(small[0, 0])
    assert small[50, 60] == pytest.approx(np.exp(np.log(full[200:204, 240:244]).mean()), rel=1e-4)


@cache
def _view(k):
    """Pose, image and true depth of a drive through the room with the cupboard, which hides a wall from the lidar."""
    T = se2_to_se3(np.array([0.12 * k, 0.25 * np.sin(0.4 * k), 0.1 * np.cos(0.4 * k)]))
    return T, *render(T)


def _drive(completes, estimate_of):
    """Results and truth of five images, of which every second is a keyframe; the first has no past images."""
    fusion = Fusion(CAMERA, T_BODY_CAMERA, floor_known=True, planar=True, completes=completes)
    results = []
    for k in range(5):
        T, image, truth = _view(k)
        beams = scan(T, np.random.default_rng(k))
        estimate = estimate_of(truth)
        kind = "none" if estimate is None else "relative"
        fusion.add_scan(in_map(T, beams))
        results.append(
            (fusion.fuse(FusionInput(k, image, T, beams, estimate, kind), keyframe=k % 2 == 0), truth)
        )
    return results


def _drifting(truth):
    """The true shape with a factor that drifts by 30 % over the image: one factor is not enough."""
    drift = np.linspace(0.85, 1.15, truth.shape[0])[:, None] * np.linspace(1.1, 0.9, truth.shape[1])[None]
    return (0.4 * drift * truth).astype(np.float32)


def test_keyframes_are_completed_and_other_images_are_not():
    """Textured surfaces: the sweep is exact where it has past images, and the estimate must not spoil it."""
    swept, completed = (_drive(completes, _drifting) for completes in (False, True))
    for (before, truth), (after, _) in list(zip(swept, completed))[2::2]:
        assert after.ok
        known = np.isfinite(before.depth_m) & np.isfinite(after.depth_m)
        assert known.mean() > 0.9
        old, new = (np.abs(result.depth_m - truth)[known] for result in (before, after))
        assert not np.array_equal(before.depth_m, after.depth_m)
        assert np.mean(new) < np.mean(old) + 0.01
        assert np.mean(new / after.sigma_m[known] < 1.0) > 0.6
    for (before, _), (after, _) in list(zip(swept, completed))[1::2]:
        np.testing.assert_array_equal(before.depth_m, after.depth_m)


def test_where_the_sweep_is_unsure_the_shape_comes_from_the_network():
    """A region swept with 30 % of error, alike over 20 px, between regions that are certain."""
    truth = _scene()
    rng = np.random.default_rng(12)
    sigma = np.full(truth.shape, 0.02, np.float32)
    sigma[:, 10:35] = 0.3
    blobs = np.kron(rng.normal(size=(H // 20, W // 20)), np.ones((20, 20)))
    measured = (truth * np.exp(sigma * blobs)).astype(np.float32)
    estimate = (0.4 * np.linspace(0.9, 1.1, H)[:, None] * truth).astype(np.float32)
    done = complete(estimate, "relative", measured, sigma)
    unsure = (slice(None), slice(12, 33))
    before, after = (np.abs(depth - truth)[unsure].mean() for depth in (measured, done.depth_m))
    assert after < 0.4 * before
    pull = np.abs(done.depth_m - truth) / (done.sigma_log * done.depth_m)
    assert np.mean(pull[unsure] < 1.0) > 0.6
    sure = (slice(None), slice(45, None))
    assert np.abs(done.depth_m / truth - 1.0)[sure].mean() < 0.025


def test_without_an_estimate_the_sweep_remains():
    swept, completed = (_drive(completes, lambda truth: None) for completes in (False, True))
    for (before, _), (after, _) in zip(swept, completed):
        np.testing.assert_array_equal(before.depth_m, after.depth_m)
        np.testing.assert_array_equal(before.sigma_m, after.sigma_m)


def test_the_service_offers_the_method():
    node = FusionNode(FusionConfig(method="poisson"))
    node.check_resources()
    assert node.config.method == "poisson"
