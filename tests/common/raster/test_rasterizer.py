"""The rasterizer's array interface: threads, several renders at once, errors; and the SIMD functions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.culling import sort_by_depth
from beamsplat.common.raster.layout import GRADIENTS, WEIGHT
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.common.raster.simd import LANES, iota
from beamsplat.common.raster.simd_math import exp2_lanes, exp_lanes, log2_lanes, sigmoid_lanes
from beamsplat.common.raster.simd_memory import gather, load, scatter_some, store, store_sums4
from tests.common.kernels import kernels_of
from tests.common.raster.scenes import random_camera, random_gaussians, random_pose


def packed(arrays):
    mean, log_scale, quat, logit, colour = arrays
    params = np.zeros((14, -(-len(mean) // 16) * 16), np.float32)
    params[:, : len(mean)] = np.concatenate([mean.T, log_scale.T, quat.T, logit[None], colour.T])
    return params, len(mean)


def scene(seed, count=400):
    rng = np.random.default_rng(seed)
    T = random_pose(rng)
    camera = random_camera(rng)
    params, count = packed(random_gaussians(rng, T, count))
    return (
        params,
        count,
        camera,
        T,
        rng.normal(size=(5, camera.height_px, camera.width_px)).astype(np.float32),
    )


def test_results_do_not_depend_on_the_number_of_threads():
    params, count, camera, T, weights = scene(1, 3000)
    results = []
    for threads in (1, 2, 3):
        rasterizer = Rasterizer(threads)
        render = rasterizer.render(params, count, camera, T)
        gradients = rasterizer.backward(render, weights)
        results.append((render.image.copy(), gradients.dense(count), gradients.pose))
        rasterizer.close()
    for other in results[1:]:
        for a, b in zip(results[0], other):
            assert np.array_equal(a, b)


def test_results_do_not_depend_on_the_order_of_gaussians():
    params, count, camera, T, weights = scene(2)
    shuffled = np.random.default_rng(0).permutation(count)
    other = params.copy()
    other[:, :count] = params[:, shuffled]
    rasterizer = Rasterizer()
    one, two = rasterizer.render(params, count, camera, T), rasterizer.render(other, count, camera, T)
    assert np.array_equal(one.image, two.image)
    a, b = rasterizer.backward(one, weights).dense(count), rasterizer.backward(two, weights).dense(count)
    assert np.allclose(a[:, shuffled], b, rtol=1e-5, atol=1e-6 * np.abs(a).max())


def test_several_renders_at_once_and_workspace_reuse():
    params, count, camera, T, weights = scene(3)
    rasterizer = Rasterizer()
    first = rasterizer.render(params, count, camera, T)
    image, gradients = first.image.copy(), rasterizer.backward(first, weights).dense(count)
    second = rasterizer.render(params, count // 2, camera, np.eye(4))
    rasterizer.backward(second, weights)
    assert np.array_equal(first.image, image)
    assert np.array_equal(rasterizer.backward(first, weights).dense(count), gradients)
    memory = first.workspace
    rasterizer.release(first)
    assert rasterizer.render(params, count, camera, T).workspace is memory


def test_pair_capacity_grows():
    """Large splats overlap all tiles: the lists grow, and the image equals that of sufficient capacity."""
    params, count, camera, T, _ = scene(4, 3000)
    params[3:6] += 2.0
    rasterizer = Rasterizer()
    rasterizer._capacity = 64
    grown = rasterizer.render(params, count, camera, T)
    assert rasterizer._capacity > 64
    assert np.array_equal(grown.image, Rasterizer().render(params, count, camera, T).image)


def test_blending_weights_sum_to_alpha():
    params, count, camera, T, _ = scene(5)
    rasterizer = Rasterizer()
    render = rasterizer.render(params, count, camera, T)
    dense = rasterizer.backward(render, np.zeros_like(render.image)).dense(count)
    assert dense.shape == (GRADIENTS, count)
    assert dense[WEIGHT].sum() == pytest.approx(render.image[4].sum(), rel=1e-5)
    assert np.all(dense[:14] == 0.0)


def test_nan_gaussians_do_not_affect_others():
    params, count, camera, T, _ = scene(6)
    rasterizer = Rasterizer()
    without = rasterizer.render(np.ascontiguousarray(params[:, 16:]), count - 16, camera, T).image.copy()
    params[:, :16] = np.nan
    assert np.array_equal(rasterizer.render(params, count, camera, T).image, without)


def test_invalid_input_raises():
    params, count, camera, T, _ = scene(7)
    rasterizer = Rasterizer()
    with pytest.raises(ValueError, match="float32"):
        rasterizer.render(params.astype(np.float64), count, camera, T)
    with pytest.raises(ValueError, match="capacity"):
        rasterizer.render(params, params.shape[1] + 1, camera, T)
    with pytest.raises(ValueError, match="T_camera_map"):
        rasterizer.render(params, count, camera, np.full((4, 4), np.nan))
    with pytest.raises(ValueError, match="background"):
        rasterizer.render(params, count, camera, T, np.zeros(4))
    with pytest.raises(ValueError, match="gradient"):
        rasterizer.backward(rasterizer.render(params, count, camera, T), np.zeros((5, 2, 2), np.float32))
    with pytest.raises(ValueError, match="positive"):
        RasterCamera(0.0, 1.0, 0.0, 0.0, 4, 4)
    with pytest.raises(ValueError, match="thread"):
        Rasterizer(0)


def test_warm_compiles_all_kernels_of_a_training_step():
    warmed, missing = kernels_of(
        warm="from beamsplat.common.raster.warm import warm; warm()",
        use="""
            import numpy as np
            from beamsplat.common.raster.optimiser import GaussianArrays, learning_rates
            from beamsplat.common.raster.rasterizer import Rasterizer
            from tests.common.raster.test_rasterizer import scene

            params, count, camera, T, weights = scene(1)
            arrays, rasterizer = GaussianArrays(4096), Rasterizer(2)
            arrays.append(params[:, :count])
            render = rasterizer.render(arrays.params, arrays.count, camera, T, np.ones(3))
            gradients = rasterizer.backward(render, weights)
            arrays.step(rasterizer.team, gradients, learning_rates(1e-3, 1e-3, 1e-3, 1e-3, 1e-3))
            assert len(gradients.index) > 0
        """,
    )
    assert len(warmed) >= 5
    assert missing == []


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0.0625, 1e4, width=32), max_size=300))
def test_radix_sort_is_stable(depths):
    depth = np.array(depths, np.float32)
    n = len(depth)
    order, other = np.zeros(n, np.int32), np.zeros(n, np.int32)
    keys, keys_other = np.zeros(n, np.uint32), np.zeros(n, np.uint32)
    sort_by_depth(depth, n, order, keys, keys_other, other)
    assert np.array_equal(order, np.argsort(depth, kind="stable"))


@njit(error_model="numpy")
def _functions(x, positive, out):
    for at in range(0, len(x), LANES):
        store(out[0], at, exp2_lanes(load(x, at)))
        store(out[1], at, log2_lanes(load(positive, at)))
        store(out[2], at, exp_lanes(load(x, at)))
        store(out[3], at, sigmoid_lanes(load(x, at)))


def test_simd_functions_have_float32_accuracy():
    rng = np.random.default_rng(0)
    x = rng.uniform(-40, 40, 64 * LANES).astype(np.float32)
    positive = np.exp(rng.uniform(-60, 60, 64 * LANES)).astype(np.float32)
    out = np.zeros((4, len(x)), np.float32)
    _functions(x, positive, out)
    wide = x.astype(np.float64)
    assert np.max(np.abs(out[0] / np.exp2(wide) - 1)) < 3e-7
    assert np.max(np.abs(out[1] - np.log2(positive.astype(np.float64)))) < 1e-5
    assert np.max(np.abs(out[2] / np.exp(wide) - 1)) < 6e-6  # the product x log2(e) is rounded to float32
    assert np.max(np.abs(out[3] - 1 / (1 + np.exp(-wide)))) < 1e-6


@njit
def _memory(a, index, out, sums):
    v = gather(a, 1, index, 0)
    scatter_some(out, 2, index, 0, v + iota(), 3)
    store_sums4(sums, 1, v, v * 2.0, -v, iota())


def test_simd_memory_operations():
    a, index = np.arange(100, dtype=np.float32), (np.arange(LANES, dtype=np.int32) * 5)[::-1].copy()
    out, sums = np.zeros(120, np.float32), np.zeros(6, np.float32)
    _memory(a, index, out, sums)
    v = a[1 + index]
    expected = np.zeros(120, np.float32)
    expected[2 + index[:3]] = v[:3] + np.arange(3)
    assert np.array_equal(out, expected)
    assert np.allclose(sums, [0, v.sum(), 2 * v.sum(), -v.sum(), np.arange(LANES).sum(), 0])
