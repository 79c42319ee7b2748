"""Carving, moves, corrections of keyframes and whole steps of the CUDA kernels, compiled for the CPU."""

import numpy as np
import pytest
import torch

from beamsplat.common.geometry.transforms import inverse, make_transform, se3_exp, so3_exp
from beamsplat.common.mapfiles.store import transform_with_momentum
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.cuda.device_map import DeviceMap
from beamsplat.common.raster.cuda.gaussians import DeviceGaussians
from beamsplat.common.raster.cuda.keyframe_states import FIELDS
from beamsplat.common.raster.cuda.training import StepSettings
from beamsplat.common.raster.layout import OPACITY
from beamsplat.common.raster.optimiser import GaussianArrays, learning_rates
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.mapping.kernels import count_carving_votes
from beamsplat.services.mapping.keyframe import StoredKeyframe, refine_exposure, refine_pose
from tests.common.raster.cuda.scenes import random_scene, relative
from tests.common.raster.cuda.shim import LOOSE, ON_GPU, kernels_under_test, needs_kernels, shim_kernels
from tests.common.raster.cuda.test_cuda_losses import cpu_loss, level_of, packed_level

pytestmark = needs_kernels

RATES = learning_rates(2e-3, 6e-3, 2e-3, 3e-2, 5e-3)


def state_of(keyframe):
    return {name: getattr(keyframe, name) for name in FIELDS}


def random_keyframe(rng, camera):
    keyframe = StoredKeyframe(0, 0, np.eye(4), camera, [])
    keyframe.delta = se3_exp(rng.normal(size=6) * 0.01)
    keyframe.exposure = (rng.normal(size=6) * 0.1).astype(np.float32)
    keyframe.pose_first, keyframe.exposure_first = rng.normal(size=6) * 1e-3, rng.normal(size=6) * 1e-3
    keyframe.pose_second, keyframe.exposure_second = rng.random(6) * 1e-5, rng.random(6) * 1e-5
    keyframe.pose_steps, keyframe.exposure_steps = 7, 11
    return keyframe


def test_begin_step_is_the_packed_camera_and_the_exposure():
    rng = np.random.default_rng(1)
    camera = RasterCamera(50.0, 52.0, 30.0, 22.0, 61, 47)
    T_map_camera, keyframe = (
        make_transform(so3_exp([0.3, -1.0, 2.0]), rng.normal(size=3)),
        random_keyframe(rng, camera),
    )
    device_map = DeviceMap(kernels_under_test(), keyframes=3)
    device_map.states.write([2], [state_of(keyframe)])
    view = device_map.training_view(61, 47)
    view.begin(camera, T_map_camera, 2)
    np.testing.assert_allclose(
        view.camera.cpu().numpy(), camera.packed(inverse(T_map_camera @ keyframe.delta)), rtol=1e-6, atol=1e-7
    )
    gain, offset = np.exp(keyframe.exposure[:3]), keyframe.exposure[3:]
    luma = np.array([0.299, 0.587, 0.114], np.float32)
    np.testing.assert_allclose(
        view.tone.cpu().numpy(), [*gain, *offset, *(luma * gain), luma @ offset], rtol=1e-6
    )
    view.begin(camera, T_map_camera)
    np.testing.assert_allclose(
        view.camera.cpu().numpy(), camera.packed(inverse(T_map_camera)), rtol=1e-6, atol=1e-7
    )
    np.testing.assert_allclose(view.tone.cpu().numpy(), [1, 1, 1, 0, 0, 0, *luma, 0])
    with pytest.raises(ValueError, match="61x47"):
        view.begin(camera.resized(30, 23), T_map_camera)


def test_states_of_keyframes_are_read_as_written():
    rng = np.random.default_rng(2)
    keyframes = [random_keyframe(rng, RasterCamera(50.0, 52.0, 30.0, 22.0, 61, 47)) for _ in range(3)]
    states = DeviceMap(kernels_under_test(), keyframes=5).states
    states.write([4, 0, 2], [state_of(k) for k in keyframes])
    for keyframe, state in zip(keyframes[1:], states.read([0, 2])):
        for name in FIELDS:
            assert np.array_equal(state[name], getattr(keyframe, name)), name


@pytest.mark.parametrize("scale", [1e-3, 1.0])
def test_steps_of_pose_and_exposure_agree_with_the_mapper(scale):
    """Small corrections, and such that reach their limits."""
    rng = np.random.default_rng(3)
    camera = RasterCamera(20.0, 20.0, 8.0, 8.0, 16, 16)
    s = StepSettings(
        refine_pose=True, refine_exposure=True, pose_m=5e-2 * scale, pose_rad=3e-2 * scale, exposure=1e-2
    )
    keyframe = random_keyframe(rng, camera)
    device_map = DeviceMap(kernels_under_test(), s, keyframes=2)
    device_map.states.write([1], [state_of(keyframe)])
    view = device_map.training_view(16, 16)
    view.begin(camera, np.eye(4), 1)
    view.prepare()
    for _ in range(12):
        pose, exposure = (rng.normal(size=6).astype(np.float32) * 0.1 for _ in range(2))
        view._buffers.pose_parts[0] = torch.from_numpy(pose)
        view._exposure_parts[0] = torch.from_numpy(exposure)
        view._finish(False)
        refine_pose(keyframe, pose.astype(float), (s.pose_m, s.pose_rad), (s.max_pose_m, s.max_pose_rad))
        refine_exposure(keyframe, exposure.astype(float), s.exposure)
        (state,) = device_map.states.read([1])
        for name in FIELDS:
            np.testing.assert_allclose(
                state[name], getattr(keyframe, name), rtol=1e-9, atol=1e-12, err_msg=name
            )
    assert np.array_equal(state["exposure"].astype(np.float32), keyframe.exposure)
    assert np.abs(keyframe.delta[:3, 3]).max() <= 0.2


def test_carving_votes_agree_with_numba():
    params, count, camera, T, _ = random_scene(8, 61, 47, count=4000)
    level, _ = level_of(61, 47)
    packed = camera.packed(T)
    expected = np.arange(count, dtype=np.int32) % 3
    kernels = kernels_under_test()
    gaussians = DeviceGaussians(kernels, count)
    gaussians.append(params[:, :count])
    gaussians.write(slice(0, count), {"carving_votes": expected})
    gaussians.vote_carving(packed_level(level).to(kernels.device), packed, (61, 47), 127, 0.08)
    voted = count_carving_votes(
        params, count, packed, level.depth_mm, level.depth_weight, np.uint8(127), 0.08, expected
    )
    votes = gaussians.read(names=("carving_votes",))["carving_votes"]
    assert voted > 100
    assert np.count_nonzero(votes != expected) <= LOOSE  # a pixel or a depth at the limit, rounded otherwise
    keep = gaussians.survivors(3, 0.0)
    assert np.array_equal(keep, (votes < 3) & (params[OPACITY, :count] > 0.0))


def test_a_rigid_motion_agrees_with_the_store():
    params, count, *_ = random_scene(8)
    rng = np.random.default_rng(1)
    T_new_old = make_transform(so3_exp([0.3, -1.0, 2.0]), rng.normal(size=3))
    group = np.sort(rng.choice(count, count // 3, replace=False))
    first = rng.normal(size=(14, count)).astype(np.float32)
    gaussians = DeviceGaussians(kernels_under_test(), count)
    gaussians.append(params[:, :count])
    gaussians.write(slice(0, count), {"first": first})
    gaussians.move(group, T_new_old)
    moved, turned = transform_with_momentum(params[:, group], first[:, group], T_new_old)
    got = gaussians.read()
    np.testing.assert_allclose(got["params"][:, group], moved, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(got["first"][:, group], turned, rtol=1e-6, atol=1e-6)
    others = np.setdiff1d(np.arange(count), group)
    assert np.array_equal(got["params"][:, others], params[:, others])
    assert np.array_equal(got["first"][:, others], first[:, others])
    gaussians.move(group[:0], T_new_old)


def test_device_gaussians_grow_and_shrink_with_their_optimiser_state():
    gaussians, rng = DeviceGaussians(kernels_under_test(), 16), np.random.default_rng(0)
    old, new = (rng.normal(size=(14, n)).astype(np.float32) for n in (200, 300))
    assert gaussians.append(old) == slice(0, 200)
    gaussians.write(
        slice(0, 200), {"first": 2 * old, "steps": np.arange(200), "carving_votes": np.arange(200)}
    )
    before = gaussians.generation
    assert gaussians.append(new) == slice(200, 500)
    assert gaussians.generation > before
    assert (gaussians.count, gaussians.capacity, int(gaussians.count_on_device)) == (500, 512, 500)
    assert gaussians.bytes_each == 3 * 14 * 4 + 8
    keep = np.arange(500) % 2 == 0
    assert gaussians.keep(keep) == 250
    state = gaussians.read()
    assert np.array_equal(state["params"], np.concatenate([old, new], axis=1)[:, keep])
    assert np.array_equal(state["first"][:, :100], 2 * old[:, keep[:200]])
    assert not state["first"][:, 100:].any()
    assert np.array_equal(state["steps"][:100], np.arange(0, 200, 2))
    assert np.array_equal(state["carving_votes"][:100], np.arange(0, 200, 2))
    chosen = np.array([249, 0, 7])
    assert np.array_equal(gaussians.read(chosen, ("params",))["params"], state["params"][:, chosen])
    gaussians.append(new[:, :5])  # columns of removed Gaussians are used again
    assert not gaussians.read(slice(250, 255), ("first",))["first"].any()
    gaussians.resize(0)
    assert gaussians.capacity == 256


def cpu_step(arrays, numba, keyframe, level, T_map_camera, settings, with_ssim):
    """A step of the mapper on the CPU; returns the loss."""
    h, w = level.depth_mm.shape
    render = numba.render(arrays.params, arrays.count, level.camera, inverse(T_map_camera @ keyframe.delta))
    result = cpu_loss(level, render.image, keyframe.exposure, settings, with_ssim)
    gradients = numba.backward(render, result.gradient)
    arrays.step(
        numba.team, gradients, RATES, settings.isotropy_weight / (h * w), np.log(settings.isotropy_ratio)
    )
    pose_rates, pose_limits = (
        (settings.pose_m, settings.pose_rad),
        (settings.max_pose_m, settings.max_pose_rad),
    )
    refine_pose(keyframe, gradients.pose, pose_rates, pose_limits)
    refine_exposure(keyframe, result.exposure, settings.exposure)
    numba.release(render)
    return result.loss


def test_whole_steps_agree_with_the_mapper():
    """Steps at two sizes with refinement: losses, Gaussians and corrections follow those of the CPU."""
    params, count, camera, T_camera_map, _ = random_scene(10, 60, 44, count=1200, more_opacity=1.0)
    settings = StepSettings(refine_pose=True, refine_exposure=True)
    levels = [level_of(60, 44, with_mask=True)[0], level_of(30, 22, with_mask=True, seed=1)[0]]
    cameras = [camera, camera.resized(30, 22)]
    for level, size in zip(levels, cameras):
        level.camera = size
    arrays, numba, keyframe = (
        GaussianArrays(count),
        Rasterizer(1),
        StoredKeyframe(0, 0, np.eye(4), camera, []),
    )
    arrays.append(params[:, :count])
    device_map = DeviceMap(kernels_under_test(), settings, keyframes=2, pairs=1 << 14)
    device_map.gaussians.append(params[:, :count])
    device_map.states.write([1], [state_of(keyframe)])
    T_map_camera, expected = inverse(T_camera_map), []
    for step in range(6):
        level, with_ssim = levels[step % 2], step % 3 == 0
        view = device_map.training_view(level.camera.width_px, level.camera.height_px)
        view.set_learning_rates(RATES)
        view.load(packed_level(level))
        view.begin(level.camera, T_map_camera, 1)
        view.run(with_ssim)
        expected.append(cpu_step(arrays, numba, keyframe, level, T_map_camera, settings, with_ssim))
    np.testing.assert_allclose(device_map.losses.read(), expected, rtol=1e-4 * LOOSE)
    mine = device_map.gaussians.read()
    seen = mine["steps"] == 6
    assert seen.sum() > 30
    before = params[:, :count][:, seen]
    change, true_change = (p[:, :count][:, seen] - before for p in (mine["params"], arrays.params))
    # Adam's first steps follow the signs of gradients near zero.
    assert relative(change, true_change) < (0.3 if ON_GPU else 0.05)
    (state,) = device_map.states.read([1])
    np.testing.assert_allclose(state["delta"], keyframe.delta, atol=2e-5)
    np.testing.assert_allclose(state["exposure"], keyframe.exposure, atol=1e-4)
    assert not device_map.grow()
    assert device_map.workspace_bytes > 0


def results_of_steps(kernels, capacity=600, pairs=1 << 14):
    """Everything that four steps change."""
    params, count, camera, T_camera_map, _ = random_scene(12, 60, 44, count=600, more_opacity=1.0)
    level, _ = level_of(60, 44, with_mask=True)
    settings = StepSettings(refine_pose=True, refine_exposure=True)
    device_map = DeviceMap(kernels, settings, keyframes=1, capacity=capacity, pairs=pairs)
    device_map.gaussians.append(params[:, :count])
    device_map.states.write([0], [state_of(StoredKeyframe(0, 0, np.eye(4), camera, []))])
    view = device_map.training_view(60, 44)
    view.set_learning_rates(RATES)
    view.load(packed_level(level))
    for step in range(4):
        view.begin(camera, inverse(T_camera_map), 0)
        view.run(with_ssim=step % 2 == 0)
    device_map.gaussians.vote_carving(view._targets, camera.packed(T_camera_map), (60, 44), 100, 0.08)
    (state,) = device_map.states.read([0])
    image, gradient = view.image.cpu().numpy(), view.gradient.cpu().numpy()
    return {
        **device_map.gaussians.read(), **state, "losses": device_map.losses.read(), "image": image,
        "gradient": gradient,
    }  # fmt: skip


def assert_same_bits(some, others):
    for name, array in some.items():
        assert np.array_equal(array, others[name]), name


def test_the_same_steps_give_the_same_bits():
    """Also with other capacities: sums do not depend on them."""
    once = results_of_steps(kernels_under_test())
    assert_same_bits(once, results_of_steps(kernels_under_test()))
    assert_same_bits(once, results_of_steps(kernels_under_test(), 3000, 1 << 15))


@pytest.mark.parametrize("tile", [8, 16])
@pytest.mark.skipif(ON_GPU, reason="a GPU chooses the order of its threads")
def test_results_do_not_depend_on_the_order_of_threads(tile):
    kernels = shim_kernels(tile)
    forwards = results_of_steps(kernels)
    with kernels.backwards():
        assert_same_bits(forwards, results_of_steps(kernels))


def test_pictures_agree_with_the_numba_rasterizer():
    params, count, camera, T, _ = random_scene(11)
    device_map = DeviceMap(kernels_under_test(), pairs=128)  # grows
    device_map.gaussians.append(params[:, :count])
    expected = Rasterizer(1).render(params, count, camera, T, np.array([0.1, 0.2, 0.3], np.float32)).image
    got = device_map.picture(camera, T, np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(got, expected, atol=2e-5 * LOOSE * np.abs(expected).max())
    for width in range(20, 30):  # many sizes: the buffers of some are freed
        device_map.picture(camera.resized(width, 15), T)
    assert len(device_map._views) <= 5
