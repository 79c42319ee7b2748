"""The fast renderers against the reference in float64: images and all gradients."""

import numpy as np
import pytest
import torch

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import se3_exp
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.mapping.renderers.protocol import RENDERERS, Gaussians, make_renderer
from tests.common.raster.cuda.shim import needs_compiler
from tests.common.raster.scenes import random_camera, random_gaussians, random_pose

NAMES = ("mean_map_m", "log_scale", "quat_wxyz", "opacity_logit", "colour", "pose", "background")


@pytest.fixture(autouse=True)
def cuda_on_the_cpu(monkeypatch):
    """The kernels of "cuda" as the CPU runs them, beside those of a GPU."""
    monkeypatch.setitem(RENDERERS, "cuda on the CPU", "tests.common.raster.cuda.shim:ShimRenderer")


def gaussians_of(arrays, dtype):
    return Gaussians(*(torch.tensor(a, dtype=dtype, requires_grad=True) for a in arrays))


def smooth_loss(picture, weights):
    """Every output matters; no kinks."""
    image = torch.cat([picture.colour, picture.depth_m[..., None], picture.alpha[..., None]], dim=-1).cpu()
    w = torch.as_tensor(weights).to(image.dtype)
    return (w * image + 0.1 * (image - 0.5) ** 2).mean()


def run(name, arrays, camera, T_camera_map, background, weights, dtype):
    gaussians = gaussians_of(arrays, dtype)
    tangent = torch.zeros(6, dtype=dtype, requires_grad=True)
    bg = torch.tensor(background, dtype=dtype, requires_grad=True)
    picture = make_renderer(name).render(gaussians, camera, T_camera_map, bg, tangent)
    smooth_loss(picture, weights).backward()
    gradients = [t.grad.double().numpy() for t in (*gaussians.tensors(), tangent, bg)]
    image = torch.cat([picture.colour, picture.depth_m[..., None], picture.alpha[..., None]], dim=-1)
    return image.detach().double().cpu().numpy(), dict(zip(NAMES, gradients))


def relative(a, b):
    return np.linalg.norm(a - b) / max(np.linalg.norm(b), 1e-12)


def scene(seed, **size):
    rng = np.random.default_rng(seed)
    T = random_pose(rng)
    camera = random_camera(rng, **size)
    weights = rng.normal(size=(camera.height_px, camera.width_px, 5))
    return random_gaussians(rng, T), camera, T, rng.uniform(0, 1, 3), weights


def backends():
    from beamsplat.common.raster.cuda.driver import cuda_fault

    return [
        "cpu",
        pytest.param("cuda on the CPU", marks=needs_compiler),
        pytest.param("cuda", marks=pytest.mark.skipif(cuda_fault() is not None, reason=str(cuda_fault()))),
    ]


@pytest.mark.parametrize("backend", backends())
def test_images_and_gradients_agree_with_float64(backend):
    errors = {name: [] for name in NAMES}
    quality = []
    for seed in range(12):
        arrays, camera, T, background, weights = scene(seed, width_px=61 + seed % 3, height_px=47 + seed % 5)
        # Both start from the float32 numbers: rounding the input is not the renderer's error.
        arrays = [a.astype(np.float32).astype(np.float64) for a in arrays]
        truth, expected = run("reference", arrays, camera, T, background, weights, torch.float64)
        image, gradients = run(backend, arrays, camera, T, background, weights, torch.float32)
        quality.append(-10 * np.log10(np.mean((image - truth)[..., :3] ** 2) + 1e-20))
        for name in NAMES:
            errors[name].append(relative(gradients[name], expected[name]))
    assert min(quality) >= 80.0, quality
    for name, values in errors.items():
        assert np.median(values) <= 1e-4, (name, values)
        assert max(values) <= 5e-4, (name, values)


@pytest.mark.parametrize("backend", backends())
@pytest.mark.parametrize("size", [(1, 1), (7, 33), (8, 32), (9, 65), (64, 5)])
def test_odd_sizes(backend, size):
    arrays, camera, T, background, weights = scene(5, width_px=size[0], height_px=size[1])
    arrays = [a.astype(np.float32).astype(np.float64) for a in arrays]
    truth, expected = run("reference", arrays, camera, T, background, weights, torch.float64)
    image, gradients = run(backend, arrays, camera, T, background, weights, torch.float32)
    assert np.abs(image - truth).max() < 1e-3 * np.abs(truth).max()
    assert relative(gradients["mean_map_m"], expected["mean_map_m"]) < 1e-3


@pytest.mark.parametrize("backend", ["reference", *backends()])
def test_nothing_in_view_is_background(backend):
    arrays, camera, T, _, _ = scene(1)
    background = torch.tensor([0.1, 0.2, 0.3])
    for chosen in (
        [a[:0] for a in arrays],
        [arrays[0] * 0 + (T[:3, :3].T @ (np.array([0, 0, -3.0]) - T[:3, 3])), *arrays[1:]],
    ):
        picture = make_renderer(backend).render(gaussians_of(chosen, torch.float32), camera, T, background)
        assert torch.allclose(picture.colour.cpu(), background.expand(camera.height_px, camera.width_px, 3))
        assert float(picture.alpha.detach().abs().max()) == 0.0
        assert bool(torch.isnan(picture.expected_depth_m()).all())


@pytest.mark.parametrize("backend", backends())
def test_two_live_graphs_do_not_disturb_each_other(backend):
    renderer = make_renderer(backend)
    arrays, camera, T, _, weights = scene(2)
    other, _, other_T, _, _ = scene(3)
    alone = gaussians_of(arrays, torch.float32)
    smooth_loss(renderer.render(alone, camera, T), weights).backward()
    first, second = gaussians_of(arrays, torch.float32), gaussians_of(other, torch.float32)
    first_loss = smooth_loss(renderer.render(first, camera, T), weights)
    second_loss = smooth_loss(renderer.render(second, camera, other_T), weights)
    second_loss.backward()
    first_loss.backward()
    for a, b in zip(alone.tensors(), first.tensors()):
        assert torch.equal(a.grad, b.grad)


def test_pose_gradient_is_that_of_the_left_perturbation():
    """Central differences of the image when the camera moves.

    A few large Gaussians under smooth weights: the cut at alpha 1/255 moves too, and no gradient knows it.
    """
    rng = np.random.default_rng(3)
    T, camera = random_pose(rng), RasterCamera(50.0, 52.0, 30.0, 22.0, 61, 47)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (6, 2)), rng.uniform(2.0, 4.0, 6)])
    arrays = ((points - T[:3, 3]) @ T[:3, :3], np.log(rng.uniform(0.1, 0.4, (6, 3))), rng.normal(size=(6, 4)),
              np.full(6, 2.0), rng.uniform(size=(6, 3)))  # fmt: skip
    v, u = np.mgrid[:47, :61] / 50.0
    weights = np.stack([u, v, u * v, u - v, u + v], axis=-1)
    _, gradients = run("cpu", arrays, camera, T, np.zeros(3), weights, torch.float32)
    renderer, step = make_renderer("reference"), 1e-3

    def loss(T_camera_map):
        with torch.no_grad():
            return float(
                smooth_loss(
                    renderer.render(gaussians_of(arrays, torch.float64), camera, T_camera_map), weights
                )
            )

    left = np.zeros(6)
    for k in range(6):
        move = np.eye(6)[k] * step
        left[k] = (loss(se3_exp(move) @ T) - loss(se3_exp(-move) @ T)) / (2 * step)
    assert relative(gradients["pose"], left) < 0.03


def test_a_single_gaussian_is_rendered_at_its_pinhole_projection():
    """Pixel centres at integers: a small splat on the ray through (20, 10) peaks there, at its depth."""
    camera = RasterCamera(50.0, 50.0, 31.0, 23.0, 64, 48)
    point = np.array([[(20 - 31.0) / 50.0 * 2.0, (10 - 23.0) / 50.0 * 2.0, 2.0]])
    arrays = (
        point,
        np.log(np.full((1, 3), 0.02)),
        np.array([[1.0, 0, 0, 0]]),
        np.array([2.0]),
        np.array([[1.0, 0.5, 0.25]]),
    )
    picture = make_renderer("cpu").render(gaussians_of(arrays, torch.float32), camera, np.eye(4))
    v, u = np.unravel_index(int(picture.alpha.argmax()), (48, 64))
    assert (u, v) == (20, 10)
    assert float(picture.alpha[10, 20]) == pytest.approx(1.0 / (1.0 + np.exp(-2.0)), abs=1e-5)
    assert float(picture.expected_depth_m()[10, 20]) == pytest.approx(2.0, abs=1e-5)


def test_unknown_and_missing_renderers_say_what_to_do():
    with pytest.raises(UserError, match="reference, cpu, cuda"):
        make_renderer("vulkan")
    if not torch.cuda.is_available():
        with pytest.raises(UserError, match=r"use the CPU|without CUDA"):
            make_renderer("cuda")
