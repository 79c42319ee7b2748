"""The losses of the CUDA kernels, compiled for the CPU, against those of the mapper in Numba."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.cuda.device_map import DeviceMap
from beamsplat.common.raster.cuda.target_cache import TargetCache
from beamsplat.common.raster.cuda.targets import pack_targets, pixel_bytes
from beamsplat.common.raster.cuda.training import StepSettings
from beamsplat.common.raster.ssim import SsimLoss
from beamsplat.common.raster.threads import ThreadTeam
from beamsplat.services.mapping.kernels import add_lidar, exposure_gradient, photometric_and_depth
from beamsplat.services.mapping.keyframe import PyramidLevel, with_hidden
from tests.common.raster.cuda.scenes import relative
from tests.common.raster.cuda.shim import LOOSE, ON_GPU, kernels_under_test, needs_kernels

pytestmark = needs_kernels

SETTINGS = StepSettings(lidar_weight=0.05, refine_exposure=True)
EXPOSURE = np.array([0.3, -0.2, 0.1, 0.05, -0.1, 0.02], np.float32)


@dataclass(frozen=True)
class CpuLoss:
    """What the mapper computes on the CPU for one image."""

    loss: float
    gradient: np.ndarray
    exposure: np.ndarray


def level_of(width, height, *, with_mask=False, beams=40, seed=0):
    """A level of a keyframe whose left half resembles the render, and its render."""
    rng = np.random.default_rng(seed)
    image = rng.random((5, height, width), dtype=np.float32)
    rgb = rng.integers(0, 256, (3, height, width)).astype(np.uint8)
    like = np.clip(image[:3] * 255 + rng.normal(0, 9, (3, height, width)), 0, 255).astype(np.uint8)
    rgb[:, :, : width // 2] = like[:, :, : width // 2]
    depth_mm = (rng.uniform(0.5, 4.0, (height, width)) * 1e3 * (rng.random((height, width)) > 0.3)).astype(
        np.uint16
    )
    weight = rng.integers(0, 256, (height, width)).astype(np.uint8)
    hidden = rng.random((height, width)) < 0.2 if with_mask else None
    pixels = rng.integers(0, max(1, height * width // 4), beams).astype(np.int32)  # several at one pixel
    z_m = rng.uniform(0.5, 4.0, beams).astype(np.float32)
    camera = RasterCamera(50.0, 50.0, 0.5 * width, 0.5 * height, width, height)
    return PyramidLevel(camera, rgb, depth_mm, weight, pixels, z_m, hidden), image


def cpu_loss(level, image, exposure, settings, with_ssim):
    """As the mapper's step computes it."""
    team, (h, w) = ThreadTeam(1), level.depth_mm.shape
    gradient, sums = np.empty((5, h, w), np.float32), np.empty((h, 2))
    if level.hidden is not None:
        level = with_hidden(level, image, exposure)
    colour_scale = np.float32((1.0 - settings.ssim_weight * with_ssim) / (3 * h * w))
    team.run(
        photometric_and_depth, image, level.rgb, level.depth_mm, level.depth_weight, exposure, colour_scale,
        np.float32(settings.depth_weight / (h * w)), gradient, sums,
    )  # fmt: skip
    loss = float(sums[:, 0].sum() * colour_scale + sums[:, 1].sum())
    if len(level.beam_pixels):
        scale = np.float32(settings.lidar_weight / len(level.beam_pixels))
        loss += add_lidar(image, level.beam_pixels, level.beam_z_m, scale, gradient)
    if with_ssim:
        loss += SsimLoss().add(image, level.rgb, exposure, settings.ssim_weight, gradient, team)
    if level.hidden is not None:
        gradient[:, level.hidden] = 0.0
    rows = np.empty((h, 6))
    team.run(exposure_gradient, image, gradient, exposure, rows)
    return CpuLoss(loss, gradient, rows.sum(axis=0))


def packed_level(level):
    return torch.from_numpy(
        pack_targets(
            level.rgb, level.depth_mm, level.depth_weight, level.hidden, level.beam_pixels, level.beam_z_m
        )
    )


@pytest.mark.parametrize("with_ssim", [False, True])
@pytest.mark.parametrize(
    ("size", "with_mask", "beams"),
    [
        ((53, 37), False, 40),
        ((53, 37), True, 40),
        ((117, 93), True, 3000),
        ((1, 1), False, 3),
        ((64, 5), False, 0),
    ],
)
def test_losses_and_gradients_agree_with_numba(size, with_mask, beams, with_ssim):
    level, image = level_of(*size, with_mask=with_mask, beams=beams)
    expected = cpu_loss(level, image, EXPOSURE, SETTINGS, with_ssim)
    device_map = DeviceMap(kernels_under_test(), SETTINGS)
    view = device_map.training_view(*size)
    view.load(packed_level(level))
    view.begin(level.camera, np.eye(4), exposure=EXPOSURE)
    view.prepare()
    view.image.copy_(torch.from_numpy(image))
    view.compute_losses(with_ssim)
    view._finish(with_ssim)
    gradient = view.gradient.cpu().numpy()
    for channel in range(5):
        assert relative(gradient[channel], expected.gradient[channel]) <= 2e-6 * LOOSE, channel
    if not with_ssim and not ON_GPU:  # the same instructions
        assert np.array_equal(gradient[3:], expected.gradient[3:])
    if with_mask:
        assert not gradient[:, level.hidden].any()
    (loss,) = device_map.losses.read()
    assert loss == pytest.approx(expected.loss, rel=2e-6 * LOOSE)
    np.testing.assert_allclose(
        view.exposure.cpu().numpy(), expected.exposure, rtol=1e-4 * LOOSE, atol=1e-6 * LOOSE
    )


def test_ssim_of_hidden_pixels_is_that_of_the_render():
    """All pixels hidden: the target is the render, rounded to 8 bits; nothing is to be learned."""
    level, image = level_of(40, 30, with_mask=True)
    level.hidden[:] = True
    device_map = DeviceMap(kernels_under_test(), SETTINGS)
    view = device_map.training_view(40, 30)
    view.load(packed_level(level))
    view.begin(level.camera, np.eye(4), exposure=np.zeros(6))
    view.prepare()
    view.image.copy_(torch.from_numpy(image))
    view.compute_losses(True)
    view._finish(True)
    assert not view.gradient.cpu().numpy().any()
    expected = cpu_loss(level, image, np.zeros(6, np.float32), SETTINGS, True)
    assert device_map.losses.read()[0] == pytest.approx(expected.loss, rel=1e-5 * LOOSE)


def test_losses_are_read_once_and_in_order():
    device_map = DeviceMap(kernels_under_test(), StepSettings(lidar_weight=0.0, depth_weight=0.0))
    view = device_map.training_view(8, 8)
    for grey in (0, 51, 102):
        rgb = np.full((3, 8, 8), grey, np.uint8)
        none = np.zeros(0, np.int32), np.zeros(0, np.float32)
        view.load(torch.from_numpy(pack_targets(rgb, np.zeros((8, 8), np.uint16), rgb[0], None, *none)))
        view.begin(RasterCamera(8.0, 8.0, 4.0, 4.0, 8, 8), np.eye(4))
        view.run()
    np.testing.assert_allclose(device_map.losses.read(), [0.0, 0.2, 0.4], atol=1e-6)
    assert len(device_map.losses.read()) == 0


def test_targets_of_many_beams_enlarge_the_buffer():
    level, image = level_of(20, 10, beams=20_000)
    view = DeviceMap(kernels_under_test(), SETTINGS).training_view(20, 10)
    view.load(packed_level(level))
    view.begin(level.camera, np.eye(4))
    view.prepare()
    view.image.copy_(torch.from_numpy(image))
    view.compute_losses()
    expected = cpu_loss(level, image, np.zeros(6, np.float32), SETTINGS, False)
    np.testing.assert_allclose(view.gradient.cpu().numpy()[3:], expected.gradient[3:], rtol=1e-6 * LOOSE)


def test_the_target_cache_frees_what_was_used_least_recently():
    cache, packed = TargetCache(kernels_under_test(), budget_bytes=250), []

    def get(key, size=100):
        def pack():
            packed.append(key)
            return np.full(size, key, np.uint8)

        assert np.array_equal(cache.get(key, pack).cpu().numpy(), np.full(size, key, np.uint8))

    for key in (1, 2, 1, 3, 1, 2):  # 2 leaves for 3, then 3 for 2
        get(key)
    assert packed == [1, 2, 3, 2]
    assert cache.held_bytes == 200
    cache.forget(1)
    cache.forget(7)
    assert cache.held_bytes == 100
    get(5, 1000)  # more than the budget: alone
    assert cache.held_bytes == 1000
    get(2)
    assert packed == [1, 2, 3, 2, 5, 2]


def test_packed_targets_hold_beams_by_pixel():
    level, _ = level_of(5, 3, beams=0)
    pixels, z_m = np.array([7, 2, 7, 0], np.int32), np.array([1.0, 2.0, 3.0, 4.0], np.float32)
    block = pack_targets(level.rgb, level.depth_mm, level.depth_weight, None, pixels, z_m)
    beams = block[pixel_bytes(5, 3) :]
    assert pixel_bytes(5, 3) == 112
    assert beams[:16].view(np.int32).tolist() == [3, 4, 0, 0]
    assert beams[16:28].view(np.int32).tolist() == [0, 2, 7]
    assert beams[28:40].view(np.int32).tolist() == [1, 2, 4]
    assert beams[40:].view(np.float32).tolist() == [4.0, 2.0, 1.0, 3.0]
    with pytest.raises(ValueError, match="outside"):
        pack_targets(level.rgb, level.depth_mm, level.depth_weight, None, pixels + 9, z_m)
    with pytest.raises(ValueError, match="size"):
        pack_targets(level.rgb[:, 1:], level.depth_mm, level.depth_weight, None, pixels, z_m)
