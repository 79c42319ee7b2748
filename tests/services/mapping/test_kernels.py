"""The losses and SSIM of the mapper against torch."""

import numpy as np
import pytest
import torch

from beamsplat.common.raster.ssim import TAPS, SsimLoss, ssim
from beamsplat.common.raster.threads import ThreadTeam
from beamsplat.services.mapping.kernels import add_lidar, photometric_and_depth

H, W = 37, 53


def pictures(seed=0):
    rng = np.random.default_rng(seed)
    image = rng.random((5, H, W), dtype=np.float32)
    rgb = rng.integers(0, 255, (3, H, W), dtype=np.uint8)
    depth = (rng.uniform(0.5, 4.0, (H, W)) * 1000 * (rng.random((H, W)) > 0.3)).astype(np.uint16)
    return image, rgb, depth, rng.integers(0, 255, (H, W), dtype=np.uint8)


def test_photometric_and_depth_loss_is_that_of_torch():
    image, rgb, depth_mm, weight = pictures()
    exposure = np.array([0.1, -0.2, 0.05, 0.01, -0.02, 0.03], np.float32)
    gradient, sums = np.full((5, H, W), np.nan, np.float32), np.zeros((H, 8))
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
    assert np.allclose(sums[:, 2:8].sum(axis=0), e.grad.numpy(), rtol=1e-3, atol=1e-2)


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
    loss = SsimLoss().add(image, rgb, 0.2, gradient, ThreadTeam(2))
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


def test_ssim_of_equal_images_is_one():
    picture = np.random.default_rng(0).random((H, W, 3))
    assert ssim(picture, picture) == pytest.approx(1.0)
    assert ssim(picture, np.roll(picture, 3, axis=0)) < 0.3
