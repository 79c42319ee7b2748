"""The CUDA rasterizer, compiled for the CPU, against the reference in float64 and the Numba rasterizer."""

import functools

import numpy as np
import pytest
import torch

from beamsplat.common.raster.cuda.view import RasterView, tile_for
from beamsplat.common.raster.layout import WEIGHT
from beamsplat.common.raster.optimiser import GaussianArrays, learning_rates
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.mapping.renderers.protocol import Gaussians, make_renderer
from tests.common.raster.cuda.scenes import packed, random_scene, relative, view_of
from tests.common.raster.cuda.shim import LOOSE, ON_GPU, kernels_under_test, needs_kernels
from tests.common.raster.scenes import random_camera, random_gaussians, random_pose

pytestmark = needs_kernels


def backward(view, gradient, learn=False):
    view.gradient.copy_(torch.from_numpy(gradient))
    view.backward(learn)
    return view.rows.cpu().numpy(), view.pose_gradient().cpu().numpy()


@functools.cache
def float64_result(seed, size, count):
    """A scene, its image and gradients by the reference renderer."""
    rng = np.random.default_rng(seed)
    T, camera = random_pose(rng), random_camera(rng, *size)
    arrays = [a.astype(np.float32).astype(np.float64) for a in random_gaussians(rng, T, count)]
    weights = rng.normal(size=(5, camera.height_px, camera.width_px))
    gaussians = Gaussians(*(torch.tensor(a, requires_grad=True) for a in arrays))
    tangent = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    render = make_renderer("reference").render(gaussians, camera, T, None, tangent)
    image = torch.cat([render.colour.permute(2, 0, 1), render.depth_m[None], render.alpha[None]])
    (torch.as_tensor(weights) * image + 0.1 * (image - 0.5) ** 2).mean().backward()
    gradients = [tensor.grad.cpu().numpy().reshape(count, -1) for tensor in gaussians.tensors()]
    return (
        arrays,
        camera,
        T,
        weights,
        image.detach().cpu().numpy(),
        np.concatenate(gradients, 1),
        tangent.grad.cpu().numpy(),
    )


@pytest.mark.parametrize(
    ("seed", "size", "count", "tile"),
    [(0, (61, 47), 400, 8), (0, (61, 47), 400, 16), (2, (65, 33), 1500, 8)],
)
def test_image_and_gradients_agree_with_float64(seed, size, count, tile):
    arrays, camera, T, weights, true_image, true_rows, true_pose = float64_result(seed, size, count)
    view = view_of(*packed(arrays), camera, T, tile=tile)
    image = view.forward().cpu().numpy().astype(np.float64)
    assert -10 * np.log10(np.mean((image - true_image) ** 2)) >= (80.0 if ON_GPU else 100.0)
    rows, pose = backward(view, ((weights + 0.2 * (image - 0.5)) / image.size).astype(np.float32))
    for row, expected in enumerate(true_rows.T):
        assert relative(rows[row, :count], expected) <= 1e-4 * LOOSE, row
    assert relative(pose, true_pose) <= 1e-4 * LOOSE


@pytest.mark.parametrize("tile", [8, 16])
@pytest.mark.parametrize("size", [(1, 1), (7, 33), (8, 32), (16, 16), (9, 65), (64, 5)])
def test_odd_sizes_agree_with_numba(tile, size):
    params, count, camera, T, weights = random_scene(5, *size)
    compare_with_numba(params, count, camera, T, weights, tile)


def compare_with_numba(params, count, camera, T, weights, tile=8, **view_options):
    numba = Rasterizer(1)
    render = numba.render(params, count, camera, T)
    gradients = numba.backward(render, weights)
    dense = gradients.dense(count)
    view = view_of(params, count, camera, T, tile=tile, **view_options)
    assert np.abs(view.forward().cpu().numpy() - render.image).max() <= 2e-5 * LOOSE * max(
        1.0, np.abs(render.image).max()
    )
    rows, pose = backward(view, weights)
    for row in range(len(dense)):
        assert relative(rows[row, :count], dense[row]) <= 1e-4 * LOOSE, row
    assert not rows[:, count:].any()
    assert relative(pose, gradients.pose) <= 2e-4 * LOOSE
    return view


@pytest.mark.parametrize("tile", [8, 16])
def test_long_lists_of_opaque_splats_end_early(tile):
    params, count, camera, T, weights = random_scene(9, 40, 30, count=6000, more_opacity=2.0)
    view = compare_with_numba(params, count, camera, T, weights, tile, pairs=1 << 16)
    longest = int(torch.diff(view._tile_start).max())
    assert 2 * tile**2 < longest
    assert int(view._tile_used.max()) < longest / 2


def test_the_same_input_gives_the_same_bits():
    params, count, camera, T, weights = random_scene(3, count=1500)
    results = []
    for _ in range(2):
        view = view_of(params, count, camera, T)
        view.set_rates(learning_rates(1e-3, 1e-3, 1e-3, 1e-3, 1e-3))
        for _ in range(3):
            view.forward()
            rows, pose = backward(view, weights, learn=True)
        results.append((view.image.cpu().numpy().copy(), rows.copy(), pose, view._gaussians.read()))
    for a, b in zip(results[0][:3], results[1][:3]):
        assert np.array_equal(a, b)
    for name, array in results[0][3].items():
        assert np.array_equal(array, results[1][3][name]), name


def test_images_do_not_depend_on_earlier_images():
    """Occluded splats and smaller views leave no sums of an earlier image."""
    params, count, camera, T, weights = random_scene(4, 40, 30, count=3000, more_opacity=2.0)
    view = view_of(params, count, camera, T, pairs=1 << 16)
    view.forward()
    rows, pose = (a.copy() for a in backward(view, weights))
    view.set_camera(camera, np.diag([-1.0, 1.0, -1.0, 1.0]) @ T)
    view.forward()
    backward(view, weights)
    view.set_camera(camera, T)
    view.forward()
    again, pose_again = backward(view, weights)
    assert np.array_equal(rows, again)
    assert np.array_equal(pose, pose_again)


def test_pairs_beyond_the_capacity_are_the_farthest_and_growth_repairs_it():
    params, count, camera, T, weights = random_scene(6, count=1500)
    full = view_of(params, count, camera, T)
    image = full.forward().cpu().numpy().copy()
    needed = int(full._buffers.most_pairs)
    view = view_of(params, count, camera, T, pairs=needed // 2)
    assert view._buffers.pairs == 0  # allocated with the first image
    short = view.forward().cpu().numpy().copy()
    kept = view._buffers.pairs
    assert needed // 2 <= kept < needed
    rows, _ = backward(view, weights)
    assert np.isfinite(short).all()
    assert np.isfinite(rows).all()
    # What is drawn lies in front of what is not.
    depth = view._buffers.depth.cpu().numpy()[:count]
    drawn = rows[WEIGHT, :count] > 0
    dropped = (view._buffers.first_pair.cpu().numpy()[:count] >= kept) & (
        view._buffers.pair_count.cpu().numpy()[:count] > 0
    )
    assert drawn.sum() > 20
    assert dropped.sum() > 50
    assert depth[drawn].max() <= depth[dropped].min()
    assert view._buffers.grow()
    assert not view._buffers.grow()
    assert np.array_equal(view.forward().cpu().numpy(), image)
    rows, _ = backward(view, weights)
    full_rows, _ = backward(full, weights)
    assert np.array_equal(rows, full_rows)


def test_adam_agrees_with_numba():
    params, count, camera, T, weights = random_scene(9, 40, 30, count=2000, more_opacity=1.0)
    rates, isotropy, ratio_log = learning_rates(2e-3, 6e-3, 2e-3, 3e-2, 5e-3), 1e-6, float(np.log(12.0))
    gradient = weights / weights.size
    view = view_of(params, count, camera, T, pairs=1 << 16)
    view.set_rates(rates, isotropy, ratio_log)
    arrays, numba = GaussianArrays(params.shape[1]), Rasterizer(1)
    arrays.append(params[:, :count])
    view.forward()
    rows, _ = backward(view, gradient, learn=True)
    render = numba.render(arrays.params, count, camera, T)
    arrays.step(numba.team, numba.backward(render, gradient), rates, isotropy, ratio_log)
    mine, seen = view._gaussians.read(), rows[WEIGHT, :count] > 0
    for name in ("params", "first", "second"):
        start = params[:, :count] if name == "params" else 0.0
        change, expected = mine[name] - start, getattr(arrays, name)[:, :count] - start
        assert relative(change[:, seen], expected[:, seen]) <= 1e-3 * LOOSE, name
    assert np.array_equal(mine["steps"], seen.astype(np.float32))
    assert np.array_equal(mine["params"][:, ~seen], params[:, :count][:, ~seen])


def test_gaussians_with_nan_are_not_drawn():
    params, count, camera, T, weights = random_scene(7)
    without = view_of(np.ascontiguousarray(params[:, 16:]), count - 16, camera, T).forward().cpu().numpy()
    broken = params.copy()
    broken[:, :16] = np.nan
    view = view_of(broken, count, camera, T)
    assert np.array_equal(view.forward().cpu().numpy(), without)
    rows, pose = backward(view, weights)
    assert np.isfinite(rows).all()
    assert np.isfinite(pose).all()


def test_no_gaussians_are_a_black_image():
    params, _, camera, T, weights = random_scene(7)
    view = view_of(params, 0, camera, T)
    assert not view.forward().cpu().numpy().any()
    rows, pose = backward(view, weights)
    assert not rows.any()
    assert not pose.any()


def test_large_images_need_large_tiles():
    assert tile_for(640, 480) == 8
    assert tile_for(1920, 1080) == 8
    assert tile_for(2560, 1440) == 16
    with pytest.raises(ValueError, match="too many"):
        tile_for(8000, 8000)
    with pytest.raises(ValueError, match="too many"):
        RasterView(kernels_under_test(8), None, None, 2560, 1440)
