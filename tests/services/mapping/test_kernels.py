"""The losses and SSIM of the mapper against torch."""

import cv2
import numpy as np
import pytest
import torch

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.ssim import TAPS, SsimLoss, ssim
from beamsplat.common.raster.threads import ThreadTeam
from beamsplat.services.mapping.kernels import add_lidar, exposure_gradient, photometric_and_depth
from beamsplat.services.mapping.keyframe import StoredKeyframe, refine_exposure

H, W = 37, 53
CAMERA = RasterCamera(50.0, 50.0, 26.0, 18.0, W, H)


def pictures(seed=0):
    rng = np.random.default_rng(seed)
    image = rng.random((5, H, W), dtype=np.float32)
    rgb = rng.integers(0, 255, (3, H, W), dtype=np.uint8)
    depth = (rng.uniform(0.5, 4.0, (H, W)) * 1000 * (rng.random((H, W)) > 0.3)).astype(np.uint16)
    return image, rgb, depth, rng.integers(0, 255, (H, W), dtype=np.uint8)


def test_photometric_and_depth_loss_is_that_of_torch():
    image, rgb, depth_mm, weight = pictures()
    exposure = np.array([0.1, -0.2, 0.05, 0.01, -0.02, 0.03], np.float32)
    gradient, sums = np.full((5, H, W), np.nan, np.float32), np.zeros((H, 2))
    ThreadTeam(2).run(
        photometric_and_depth,
        image,
        rgb,
        depth_mm,
        weight,
        exposure,
        np.float32(0.3),
        np.float32(0.7),
        gradient,
        sums,
    )
    x = torch.tensor(image, dtype=torch.float64, requires_grad=True)
    e = torch.tensor(exposure, dtype=torch.float64, requires_grad=True)
    colour = (
        x[:3] * e[:3].exp()[:, None, None] + e[3:, None, None] - torch.tensor(rgb) / 255.0
    ).abs().sum() * 0.3
    d = torch.tensor(depth_mm.astype(np.float64)) * 1e-3
    w = torch.tensor(weight) / 255.0 * 0.7 * (d > 0)
    depth = (w * (x[3] - d * x[4]).abs()).sum()
    (colour + depth).backward()
    assert np.allclose(gradient, x.grad.numpy(), atol=1e-5)
    assert sums[:, 0].sum() * 0.3 == pytest.approx(float(colour), rel=1e-5)
    assert sums[:, 1].sum() == pytest.approx(float(depth), rel=1e-5)
    rows = np.empty((H, 6))
    ThreadTeam(2).run(exposure_gradient, image, gradient, exposure, rows)
    assert np.allclose(rows.sum(axis=0), e.grad.numpy(), rtol=1e-3, atol=1e-2)


def test_lidar_loss_has_gradients_at_the_beams_only():
    image, *_ = pictures()
    gradient = np.zeros((5, H, W), np.float32)
    pixels, z = np.array([5, 5 * W + 7], np.int32), np.array([1.0, 2.0], np.float32)
    loss = add_lidar(image, pixels, z, np.float32(0.5), gradient)
    flat = image.reshape(5, -1)[:, pixels]
    error = flat[3] - z * flat[4]
    assert loss == pytest.approx(0.5 * np.abs(error).sum(), rel=1e-5)
    assert np.count_nonzero(gradient) == 4
    assert np.allclose(gradient.reshape(5, -1)[3, pixels], 0.5 * np.sign(error))


def test_ssim_gradient_is_that_of_torch():
    image, rgb, *_ = pictures(1)
    gradient = np.zeros((5, H, W), np.float32)
    loss = SsimLoss().add(image, rgb, np.zeros(6, np.float32), 0.2, gradient, ThreadTeam(2))
    taps = torch.tensor(TAPS, dtype=torch.float64)
    kernel = (taps[:, None] * taps[None])[None, None]
    luma = torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64)
    x = torch.tensor(image[:3], dtype=torch.float64, requires_grad=True)
    a, b = (
        (luma @ x.reshape(3, -1)).reshape(1, 1, H, W),
        (luma @ (torch.tensor(rgb) / 255.0).double().reshape(3, -1)).reshape(1, 1, H, W),
    )

    def blur(t):
        return torch.nn.functional.conv2d(t, kernel, padding=5)

    mx, my = blur(a), blur(b)
    xx, yy, xy = blur(a * a) - mx**2, blur(b * b) - my**2, blur(a * b) - mx * my
    value = ((2 * mx * my + 1e-4) * (2 * xy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (xx + yy + 9e-4))).mean()
    expected = 0.1 * (1.0 - value)
    expected.backward()
    assert loss == pytest.approx(float(expected), rel=1e-4)
    assert np.linalg.norm(gradient[:3] - x.grad.numpy()) < 1e-3 * np.linalg.norm(x.grad.numpy())


def colour_loss(image, rgb, exposure, weights):
    """The colour loss in float64: L1 and SSIM of the render after its exposure."""
    shown = image[:3] * np.exp(exposure[:3])[:, None, None] + exposure[3:, None, None]
    true = rgb / 255.0
    taps, luma = TAPS.astype(np.float64), np.array([0.299, 0.587, 0.114])

    def blur(x):
        return cv2.sepFilter2D(x, cv2.CV_64F, taps, taps, borderType=cv2.BORDER_CONSTANT)

    a, b = np.tensordot(luma, shown, 1), np.tensordot(luma, true, 1)
    mx, my = blur(a), blur(b)
    xx, yy, xy = blur(a * a) - mx**2, blur(b * b) - my**2, blur(a * b) - mx * my
    value = (2 * mx * my + 1e-4) * (2 * xy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (xx + yy + 9e-4))
    return weights[0] * np.abs(shown - true).mean() + weights[1] * 0.5 * (1.0 - value.mean())


@pytest.mark.parametrize("weights", [(0.8, 0.2), (0.0, 1.0)])
def test_the_gradients_of_the_colour_loss_are_its_finite_differences(weights):
    image, rgb, depth_mm, weight = pictures(2)
    rgb = (255 * (0.2 + 0.5 * image[:3] + 0.1 * np.random.default_rng(3).random((3, H, W)))).astype(np.uint8)
    exposure = np.array([0.3, -0.2, 0.1, 0.05, -0.1, 0.02], np.float32)
    gradient, sums, rows, team = (
        np.empty((5, H, W), np.float32),
        np.empty((H, 2)),
        np.empty((H, 6)),
        ThreadTeam(2),
    )
    scale = np.float32(weights[0] / (3 * H * W))
    team.run(
        photometric_and_depth, image, rgb, depth_mm, weight, exposure, scale, np.float32(0.0), gradient, sums
    )
    loss = SsimLoss().add(image, rgb, exposure, weights[1], gradient, team) + sums[:, 0].sum() * scale
    team.run(exposure_gradient, image, gradient, exposure, rows)
    x, e = image.astype(np.float64), exposure.astype(np.float64)
    assert loss == pytest.approx(colour_loss(x, rgb, e, weights), rel=1e-4)

    def slope(change_x, change_e, step):
        sides = [colour_loss(x + s * change_x, rgb, e + s * change_e, weights) for s in (step, -step)]
        return (sides[0] - sides[1]) / (2.0 * step)

    by_exposure = [slope(0.0, unit, 1e-6) for unit in np.eye(6)]
    np.testing.assert_allclose(rows.sum(axis=0), by_exposure, rtol=2e-3, atol=1e-5)
    for channel, v, u in ((0, 0, 0), (1, 20, 30), (2, 36, 52), (1, 5, 50)):
        unit = np.zeros_like(x)
        unit[channel, v, u] = 1.0
        assert gradient[channel, v, u] == pytest.approx(slope(unit, 0.0, 1e-6), rel=2e-3, abs=1e-8)


def test_an_image_that_its_exposure_explains_has_no_ssim_loss():
    image = np.random.default_rng(4).random((5, H, W), dtype=np.float32)
    exposure = np.array([-0.5, -0.4, -0.6, 0.1, 0.05, 0.12], np.float32)
    shown = image[:3] * np.exp(exposure[:3])[:, None, None] + exposure[3:, None, None]
    gradient = np.zeros((5, H, W), np.float32)
    loss = SsimLoss().add(image, shown * np.float32(255.0), exposure, 1.0, gradient, ThreadTeam(1))
    assert loss == pytest.approx(0.0, abs=1e-4)
    assert np.abs(gradient).max() < 1e-6


def test_adam_of_the_exposure_counts_its_own_steps():
    """With a constant gradient, each step of Adam has the size of the rate, whatever the pose has done."""
    for pose_steps in (0, 1000):
        keyframe = StoredKeyframe(0, 0, np.eye(4), CAMERA, [], pose_steps=pose_steps)
        for step in range(1, 11):
            refine_exposure(keyframe, np.full(6, -1.0), 0.01)
            np.testing.assert_allclose(keyframe.exposure, 0.01 * step, rtol=1e-3)
        assert (keyframe.pose_steps, keyframe.exposure_steps) == (pose_steps, 10)


def test_ssim_of_equal_images_is_one():
    picture = np.random.default_rng(0).random((H, W, 3))
    assert ssim(picture, picture) == pytest.approx(1.0)
    assert ssim(picture, np.roll(picture, 3, axis=0)) < 0.3
