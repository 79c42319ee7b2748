"""Adam compared with torch, growable arrays, and initial discs on surfaces."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.common.geometry.transforms import make_transform, matrix_from_quat_wxyz, so3_exp
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.discs import choose_pixels, disc_quats, make_discs
from beamsplat.common.raster.layout import GRADIENTS, MEAN, OPACITY, QUAT, SCALE, WEIGHT
from beamsplat.common.raster.optimiser import GaussianArrays, adam, learning_rates
from beamsplat.common.raster.threads import ThreadTeam


def test_adam_matches_torch_for_visible_gaussians():
    rng = np.random.default_rng(2)
    count, capacity = 100, 112
    params = rng.normal(size=(14, capacity)).astype(np.float32)
    params[3:6] = 0.0  # equal axes: no isotropic regularisation
    index = np.sort(rng.choice(count, 61, replace=False)).astype(np.int32)
    padded = np.concatenate([index, np.full(32, index[-1], np.int32)])
    first, second, steps = np.zeros_like(params), np.zeros_like(params), np.zeros(capacity, np.float32)
    theirs = torch.tensor(params[:, index], requires_grad=True)
    optimiser = torch.optim.Adam([theirs], lr=0.01, eps=1e-15)
    untouched = params.copy()
    for _ in range(20):
        gradients = np.zeros((GRADIENTS, 64), np.float32)
        gradients[:14, :61] = rng.normal(size=(14, 61))
        gradients[WEIGHT] = 1.0
        ThreadTeam(1).run(adam, gradients, padded[:61], params, first, second, steps,
                    learning_rates(0.01, 0.01, 0.01, 0.01, 0.01), np.float32(0.0), np.float32(9.0))  # fmt: skip
        theirs.grad = torch.tensor(gradients[:14, :61])
        optimiser.step()
    assert np.allclose(params[:, index], theirs.detach().numpy(), atol=2e-5)
    others = np.setdiff1d(np.arange(capacity), index)
    assert np.array_equal(params[:, others], untouched[:, others])
    assert np.all(steps[index] == 20.0)


def test_isotropic_regularisation_shortens_needles():
    params = np.zeros((14, 16), np.float32)
    params[3:6, 0] = np.log([1.0, 0.1, 0.01])
    moments = np.zeros((2, 14, 16), np.float32)
    gradients = np.zeros((GRADIENTS, 16), np.float32)
    gradients[WEIGHT] = 1.0
    index = np.zeros(16, np.int32)
    ThreadTeam(1).run(adam, gradients, index[:1], params, moments[0], moments[1], np.zeros(16, np.float32),
                learning_rates(0.0, 0.01, 0.0, 0.0, 0.0), np.float32(1.0), np.float32(np.log(4.0)))  # fmt: skip
    assert params[3, 0] == pytest.approx(-0.01, abs=1e-6)
    assert np.allclose(params[4:6, 0], np.log([0.1, 0.01]), atol=1e-6)


def test_arrays_grow_and_shrink_with_their_optimiser_state():
    arrays = GaussianArrays(16)
    first, second = (np.full((14, n), float(n), np.float32) for n in (10, 30))
    assert arrays.append(first) == slice(0, 10)
    arrays.first[:, :10] = 7.0
    assert arrays.append(second) == slice(10, 40)
    assert arrays.capacity % 16 == 0
    keep = np.arange(40) % 2 == 0
    assert arrays.keep(keep) == 20
    assert arrays.count == 20
    assert np.array_equal(arrays.params[0, :20], np.repeat([10.0, 30.0], [5, 15]).astype(np.float32))
    assert np.array_equal(arrays.first[0, :20], np.repeat([7.0, 0.0], [5, 15]).astype(np.float32))
    arrays.append(first)  # reuses columns of removed Gaussians, whose state must be zero
    assert not arrays.first[:, 20:30].any()


CAMERA = RasterCamera(200.0, 200.0, 79.5, 59.5, 160, 120)


def test_discs_on_a_slanted_wall():
    """Plane z = 2 + x / 2: disc centres on the plane, discs flat along its normal."""
    rays = (np.arange(160) - CAMERA.cx_px) / CAMERA.fx_px
    z = np.tile((2.0 / (1.0 - 0.5 * rays)).astype(np.float32), (120, 1))
    grey = np.full((120, 160), 0.5, np.float32)
    u, v, spacing = choose_pixels(z > 0, grey, 4, 2, 0.1)
    assert len(u) == 40 * 30
    assert np.all(spacing == 4)
    T = make_transform(so3_exp([0.1, -0.3, 0.2]), np.array([1.0, 2.0, 3.0]))
    rgb = np.full((3, len(u)), 0.5, np.float32)
    discs = make_discs(u, v, spacing, z, rgb, CAMERA, T, size=0.5, flatness=0.1, opacity=0.8, least_slant=0.2)
    inside = (u > 2) & (u < 157) & (v > 2) & (v < 117)
    normal = T[:3, :3] @ (np.array([0.5, 0.0, -1.0]) / np.sqrt(1.25))
    centre = T[:3, :3] @ np.array([0.0, 0.0, 2.0]) + T[:3, 3]
    off_m = normal @ (discs[MEAN:SCALE].astype(np.float64) - centre[:, None])
    assert np.abs(off_m).max() < 1e-5
    axes = np.array([matrix_from_quat_wxyz(q)[:, 2] for q in discs[QUAT:OPACITY, inside].T])
    assert np.abs(axes @ normal).min() > 0.999
    spread_m = np.exp(discs[SCALE + 1])
    assert np.allclose(spread_m, 0.5 * 4 * z[v, u] / 200.0, rtol=1e-5)
    assert np.all(discs[SCALE, inside] > discs[SCALE + 1, inside])  # longer down the slope


def test_choose_pixels_follows_texture_and_mask():
    grey = np.full((40, 80), 0.5, np.float32)
    grey[:, 40:] = np.where(np.arange(40) % 4 < 2, 0.9, 0.5)
    wanted = np.ones((40, 80), bool)
    wanted[:, :20] = False
    u, _, spacing = choose_pixels(wanted, grey, 8, 2, 0.1)
    assert u.min() >= 20
    assert set(spacing[u < 32]) == {8.0}
    assert set(spacing[u > 48]) == {2.0}


_UNIT = st.tuples(*[st.floats(-1, 1) for _ in range(3)]).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=60, deadline=None)
@given(_UNIT, _UNIT)
def test_disc_orientation_follows_normal_and_slope(normal, ray):
    n, r = (np.array(v) / np.linalg.norm(v) for v in (normal, ray))
    slope = r - n * (n @ r)
    R = matrix_from_quat_wxyz(disc_quats(n[None], r[None])[0])
    assert abs(R[:, 2] @ n) == pytest.approx(1.0, abs=1e-9)
    if np.linalg.norm(slope) > 1e-3:
        assert R[:, 0] @ slope / np.linalg.norm(slope) == pytest.approx(1.0, abs=1e-6)
