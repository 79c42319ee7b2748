"""Spherical harmonics: orthonormal, the published values, rotations, kernels against finite differences."""

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import so3_exp
from beamsplat.common.harmonics.basis import basis, coefficients, degree_of, rotated, with_degree
from beamsplat.common.harmonics.kernels import shade, shade_backward
from beamsplat.common.raster.layout import COLOUR, MEAN, WEIGHT


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def directions(rng, count):
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_the_functions_are_orthonormal_on_the_sphere(rng):
    values = np.column_stack([np.full(400_000, 0.28209479177387814), basis(directions(rng, 400_000), 3)])
    gram = 4.0 * np.pi * values.T @ values / len(values)
    np.testing.assert_allclose(gram, np.eye(16), atol=0.03)


def test_the_signs_and_the_order_are_those_of_3dgs():
    along = basis(np.eye(3), 3)
    c1 = 0.4886025119029199
    np.testing.assert_allclose(along[:, :3], [[0, 0, -c1], [-c1, 0, 0], [0, c1, 0]])
    assert along[2, 5] == pytest.approx(2 * 0.31539156525252005)
    assert along[2, 11] == pytest.approx(2 * 0.3731763325901154)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_rotated_coefficients_show_the_same_in_rotated_directions(rng, degree):
    rows = rng.normal(size=(3 * coefficients(degree), 5)).astype(np.float32)
    R, d = so3_exp(rng.normal(size=3)), directions(rng, 20)
    blocks, turned = (r.reshape(3, -1, 5).astype(float) for r in (rows, rotated(rows, R)))
    before = np.einsum("sk,ckn->scn", basis(d, degree), blocks)
    after = np.einsum("sk,ckn->scn", basis(d @ R.T, degree), turned)
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_the_degree_can_be_changed():
    rows = np.arange(9.0 * 2, dtype=np.float32).reshape(9, 2)
    higher = with_degree(rows, 2)
    assert higher.shape == (24, 2)
    np.testing.assert_array_equal(higher.reshape(3, 8, 2)[:, :3], rows.reshape(3, 3, 2))
    np.testing.assert_array_equal(with_degree(higher, 1), rows)
    assert with_degree(rows, 0).shape == (0, 2)
    assert [degree_of(3 * coefficients(d)) for d in range(4)] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="0 to 3, not 4"):
        coefficients(4)
    with pytest.raises(ValueError, match="7 rows"):
        degree_of(7)


def colours(params, rows, centre):
    out = params.copy()
    shade(params, rows, params.shape[1], centre, out)
    return out[COLOUR:].astype(float)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_kernels_agree_with_the_functions_and_with_finite_differences(rng, degree):
    count, terms = 6, coefficients(degree)
    params = rng.normal(size=(14, count)).astype(np.float32)
    rows = rng.normal(size=(3 * terms, count)).astype(np.float32)
    centre = rng.normal(size=3) + 4.0
    d = params[:3].T.astype(float) - centre
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    expected = params[COLOUR:] + np.einsum("nk,ckn->cn", basis(d, degree), rows.reshape(3, terms, count))
    np.testing.assert_allclose(colours(params, rows, centre), expected, atol=1e-5)

    seen = rng.normal(size=(3, count))
    gradients = np.zeros((16, count), np.float32)
    gradients[COLOUR:14], gradients[WEIGHT] = seen, 1.0
    first, second = np.zeros_like(rows), np.zeros_like(rows)
    steps, index, of_centre = np.zeros(count, np.float32), np.arange(count, dtype=np.int32), np.zeros(3)
    shade_backward(params, rows, first, second, steps, index, gradients, centre, 0.0, of_centre)
    assert not first.any()  # without a rate nothing is changed

    def loss(centre_map_m):
        return float(np.sum(colours(params, rows, centre_map_m) * seen))

    steps_m = 1e-2 * np.eye(3)
    numeric = [(loss(centre + s) - loss(centre - s)) / 2e-2 for s in steps_m]
    np.testing.assert_allclose(of_centre, numeric, atol=2e-3 * np.abs(numeric).max() + 1e-4)
    np.testing.assert_allclose(gradients[MEAN : MEAN + 3].sum(axis=1), -of_centre, atol=1e-5)

    before, value = rows.copy(), loss(centre)
    shade_backward(params, rows, first, second, steps, index, gradients, centre, 1e-3, of_centre)
    # Adam's first step is the rate against the sign of the gradient.
    sign = np.sign(np.einsum("nk,cn->ckn", basis(d, degree), seen)).reshape(rows.shape)
    np.testing.assert_allclose(rows - before, -1e-3 * sign, atol=1e-5)
    assert loss(centre) < value
