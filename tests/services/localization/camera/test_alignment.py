"""Alignment of an image to the rendered map: equations against reference code, poses against the truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.common.geometry.transforms import inverse, make_transform, se3_exp, so3_exp
from beamsplat.services.localization.camera.align import Aligner, Alignment, motion_basis, rasterizer_gradient
from beamsplat.services.localization.camera.image_pyramid import make_image_pyramid, tracking_camera
from beamsplat.services.localization.camera.kernels import map_loss, normal_equations, select_points
from beamsplat.services.localization.camera.settings import CameraTrackerSettings
from beamsplat.services.localization.camera.splat_map import MapKeyframe, SplatMap
from tests.services.localization.camera.box import CAMERA, T_BODY_CAMERA, body, pose_error, render_view

SETTINGS = CameraTrackerSettings(width_px=160)


@pytest.fixture(scope="module")
def splats():
    camera = tracking_camera(CAMERA, 160)
    splats = SplatMap(camera, SETTINGS)
    rgb, z = render_view(body(0, 0, 0))
    planes = np.ascontiguousarray(rgb.transpose(2, 0, 1)).astype(np.float32) / 255
    frame = MapKeyframe(
        1, T_BODY_CAMERA, planes, z, np.ones_like(z), np.zeros(0, np.int32), np.zeros((15, 20))
    )
    splats.add(frame)
    for _ in range(30):
        splats.step(frame)
    yield splats
    splats.close()


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("move", [(0.08, 0.0, 0.02), (0.0, 0.0, -0.12), (-0.06, 0.03, 0.05)])
def test_alignment_converges_from_a_wrong_start(splats, planar, move):
    settings = CameraTrackerSettings(width_px=160, planar=planar)
    aligner = Aligner(splats.camera, T_BODY_CAMERA, settings)
    T_map_body = body(*move)
    found = aligner.align(
        splats,
        make_image_pyramid(render_view(T_map_body)[0], splats.camera, 3),
        Alignment(inverse(T_BODY_CAMERA)),
    )
    T_found = inverse(found.T_camera_map) @ inverse(T_BODY_CAMERA)
    metres, radians = pose_error(T_map_body, T_found)
    assert metres < (0.008 if planar else 0.012)
    assert radians < 0.007  # a degree is 2.4 px here
    assert found.inlier_ratio > 0.8
    if planar:
        assert abs(T_found[2, 3]) < 1e-9
        assert T_found[2, 2] == pytest.approx(1.0, abs=1e-12)


def test_exposure_does_not_bias_the_pose(splats):
    aligner = Aligner(splats.camera, T_BODY_CAMERA, SETTINGS)
    T_map_body = body(0.05, 0.0, 0.03)
    rgb = (render_view(T_map_body)[0] * 0.8 + 10.0).astype(np.uint8)
    found = aligner.align(
        splats, make_image_pyramid(rgb, splats.camera, 3), Alignment(inverse(T_BODY_CAMERA))
    )
    assert pose_error(T_map_body, inverse(found.T_camera_map) @ inverse(T_BODY_CAMERA))[0] < 0.010
    assert found.gain == pytest.approx(0.8, abs=0.08)


def test_the_rasterizer_gradient_is_small_at_the_optimum_and_points_uphill_elsewhere(splats):
    aligner = Aligner(splats.camera, T_BODY_CAMERA, SETTINGS)
    T_map_body = body(0.04, 0.0, 0.02)
    image = make_image_pyramid(render_view(T_map_body)[0], splats.camera, 3)
    found = aligner.align(splats, image, Alignment(inverse(T_BODY_CAMERA)))
    basis = motion_basis(T_BODY_CAMERA, True)
    here, _ = rasterizer_gradient(splats, splats.camera, image.levels[0], found, SETTINGS)
    move = basis @ np.array([0.03, 0.0, 0.0])
    shifted = Alignment(
        se3_exp(move) @ found.T_camera_map, error=found.error, gain=found.gain, offset=found.offset
    )
    there, _ = rasterizer_gradient(splats, splats.camera, image.levels[0], shifted, SETTINGS)
    assert move @ there > 0.0  # the gradient points away from the optimum
    assert np.linalg.norm(basis.T @ here) < 0.25 * np.linalg.norm(basis.T @ there)


def _residuals(points, K, T, image, gain, offset):
    """Return the residual of each point, NaN outside: slow reference code."""
    fx, fy, cx, cy = K
    z = points[:, 2].astype(np.float64)
    X = np.stack([(points[:, 0] - cx) / fx * z, (points[:, 1] - cy) / fy * z, z], axis=1)
    X = X @ T[:3, :3].T + T[:3, 3]
    u, v = fx * X[:, 0] / X[:, 2] + cx, fy * X[:, 1] / X[:, 2] + cy
    h, w = image.shape
    out = np.full(len(points), np.nan)
    for i in range(len(points)):
        if X[i, 2] >= 0.05 and 0 <= u[i] < w - 1 and 0 <= v[i] < h - 1:
            c, r = int(u[i]), int(v[i])
            a, b = u[i] - c, v[i] - r
            top = (1 - a) * image[r, c] + a * image[r, c + 1]
            low = (1 - a) * image[r + 1, c] + a * image[r + 1, c + 1]
            out[i] = (1 - b) * top + b * low - (gain * points[i, 3] + offset)
    return out


def test_normal_equations_against_finite_differences():
    # The image is linear in u and v, so its gradients are exact.
    random = np.random.default_rng(2)
    v, u = np.mgrid[0:60, 0:80].astype(np.float64)
    image = (0.004 * u + 0.006 * v).astype(np.float32)
    gradient_x, gradient_y = np.full_like(image, 0.004), np.full_like(image, 0.006)
    points = np.column_stack(
        [
            random.uniform(10, 70, 50),
            random.uniform(10, 50, 50),
            random.uniform(1, 4, 50),
            random.uniform(0, 0.6, 50),
        ]
    ).astype(np.float32)
    K, T = np.array([70.0, 72.0, 39.5, 29.5]), se3_exp(np.array([0.02, -0.01, 0.03, 0.01, -0.02, 0.015]))
    H, g, residuals = np.zeros((8, 8)), np.zeros(8), np.zeros(50, np.float32)
    gain, offset = 0.9, 0.02
    used, cost = normal_equations(
        points,
        50,
        K,
        T[:3, :3].copy(),
        T[:3, 3].copy(),
        image,
        gradient_x,
        gradient_y,
        gain,
        offset,
        10.0,
        H,
        g,
        residuals,
    )
    slow = _residuals(points, K, T, image.astype(np.float64), gain, offset)
    assert used == np.isfinite(slow).sum()
    np.testing.assert_allclose(residuals, slow, atol=1e-5)
    J, eps = np.zeros((50, 8)), 1e-5
    for k in range(8):
        step = np.zeros(8)
        step[k] = eps
        ends = [
            _residuals(
                points,
                K,
                se3_exp(s * step[:6]) @ T,
                image.astype(np.float64),
                gain * np.exp(s * step[6]),
                offset + s * step[7],
            )
            for s in (1, -1)
        ]
        J[:, k] = (ends[0] - ends[1]) / (2 * eps)
    good = np.isfinite(slow) & np.all(np.isfinite(J), axis=1)
    np.testing.assert_allclose(g, J[good].T @ slow[good], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(H, J[good].T @ J[good], rtol=2e-3, atol=1e-4)
    assert cost == pytest.approx(0.5 * np.nansum(slow**2), rel=1e-4)


def test_selected_points_have_contrast_and_an_opaque_map():
    random = np.random.default_rng(1)
    grey, z = random.uniform(0, 1, (30, 40)).astype(np.float32), np.full((30, 40), 2.0, np.float32)
    alpha = np.ones((30, 40), np.float32)
    grey[:, 20:], alpha[:10] = 0.5, 0.2
    z[25:] = 0.0
    out = np.zeros((2000, 4), np.float32)
    n, found = select_points(grey, z, alpha, np.float32(0.01), np.float32(0.8), 1, out)
    assert n == found
    assert n > 100
    u, v = out[:n, 0].astype(int), out[:n, 1].astype(int)
    assert u.max() <= 20
    assert v.min() >= 11
    assert v.max() < 25
    assert np.array_equal(out[:n, 3], grey[v, u])
    assert select_points(grey, z, alpha, np.float32(0.01), np.float32(0.8), 3, out) == (n // 3, n)


def test_the_map_loss_gradient_against_finite_differences():
    random = np.random.default_rng(3)
    image = random.uniform(0.2, 0.9, (5, 6, 8)).astype(np.float32)
    rgb = random.uniform(0, 1, (3, 6, 8)).astype(np.float32)
    z, weight = (
        random.uniform(1, 3, (6, 8)).astype(np.float32),
        random.uniform(0, 1, (6, 8)).astype(np.float32),
    )
    z[0, :3] = 0.0
    scales, gradient, scratch = (np.float32(0.1), np.float32(0.3)), np.zeros_like(image), np.zeros_like(image)
    loss = map_loss(image, rgb, z, weight, *scales, gradient)
    colour = np.abs(image[:3] / np.maximum(image[4], 0.3) - rgb).sum() * scales[0]
    depth = (weight * np.abs(image[3] - z * image[4]))[z > 0].sum() * scales[1]
    gaps = (1.0 - image[4])[z > 0].sum() * scales[0]
    assert loss == pytest.approx(colour + depth + gaps, rel=1e-4)
    for at in [(0, 2, 3), (2, 5, 7), (3, 1, 1), (4, 4, 6), (3, 0, 1)]:
        moved = image.copy()
        moved[at] += 1e-3
        slope = (map_loss(moved, rgb, z, weight, *scales, scratch) - loss) / 1e-3
        assert slope == pytest.approx(gradient[at], rel=1e-2, abs=2e-3)


@settings(max_examples=40, deadline=None)
@given(st.tuples(*[st.floats(-0.5, 0.5) for _ in range(3)]), st.tuples(*[st.floats(-3, 3) for _ in range(3)]))
def test_planar_motions_keep_a_body_on_its_floor(motion, turn):
    T_body_camera = make_transform(so3_exp(np.array(turn)), np.array([0.1, -0.2, 0.5]))
    T_camera_map = se3_exp(motion_basis(T_body_camera, True) @ np.array(motion)) @ inverse(T_body_camera)
    T_map_body = inverse(T_camera_map) @ inverse(T_body_camera)
    assert abs(T_map_body[2, 3]) < 1e-9
    np.testing.assert_allclose(T_map_body[2, :3], [0, 0, 1], atol=1e-9)
