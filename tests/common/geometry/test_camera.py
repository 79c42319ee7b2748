"""Pinhole cameras: projection is the inverse of rays, scaling of K, undistortion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamsplat.common.geometry.camera import Pinhole, Undistorter

PLAIN = Pinhole(530.0, 520.0, 319.5, 239.5, 640, 480)
PLUMB = Pinhole(
    519.27, 518.89, 331.11, 229.43, 640, 480, "plumb_bob", (0.1142, 0.1934, -0.0027, 0.0037, -1.0954)
)
FISHEYE = Pinhole(300.0, 300.0, 320.0, 240.0, 640, 480, "equidistant", (0.02, -0.01, 0.003, -0.001))


@pytest.mark.parametrize("camera", [PLAIN, PLUMB, FISHEYE])
@given(u=st.floats(100, 560), v=st.floats(80, 400), z=st.floats(0.2, 30))
def test_projecting_a_ray_returns_its_pixel(camera, u, v, z):
    ray = camera.rays(np.array([[u, v]]))
    assert ray[0, 2] == 1.0
    uv, inside = camera.project(z * ray)
    assert inside[0]
    assert np.allclose(uv[0], [u, v], atol=0.02)


def test_points_behind_the_camera_or_outside_the_image_are_flagged():
    uv, inside = PLAIN.project(np.array([[0.0, 0.0, -1.0], [5.0, 0.0, 1.0], [0.0, 0.0, 1.0]]))
    assert inside.tolist() == [False, False, True]
    assert np.isnan(uv[0]).all()
    assert np.allclose(uv[2], [319.5, 239.5])


def test_points_far_outside_are_flagged_with_a_non_monotonic_polynomial():
    folding = Pinhole(500.0, 500.0, 320.0, 240.0, 640, 480, "plumb_bob", (-0.4, 0.0, 0.0, 0.0, 0.0))
    far = np.array([[2.5, 0.0, 1.0]])
    assert not folding.project(far)[1][0]


def test_resizing_keeps_the_edges_of_the_field_of_view():
    small = PLAIN.resized(160, 120)
    corner = PLAIN.rays(np.array([[-0.5, -0.5], [639.5, 479.5]]))
    assert np.allclose(small.project(corner)[0], [[-0.5, -0.5], [159.5, 119.5]])


@pytest.mark.parametrize("camera", [PLUMB, FISHEYE])
def test_undistorted_image_matches_pinhole_projection(camera):
    rng = np.random.default_rng(3)
    for point in rng.uniform([-0.3, -0.2, 1.0], [0.3, 0.2, 2.0], (10, 3)):
        (u, v), (inside,) = camera.project(point[None])[0][0], camera.project(point[None])[1]
        assert inside
        image = np.zeros((480, 640), np.uint8)
        yy, xx = np.mgrid[:480, :640]
        image[:] = np.clip(255 * np.exp(-((xx - u) ** 2 + (yy - v) ** 2) / 18.0), 0, 255)
        straight = Undistorter(camera)(image).astype(float)
        weight = straight[straight > 25]
        where = np.argwhere(straight > 25)[:, ::-1]
        centre = (where * weight[:, None]).sum(0) / weight.sum()
        assert np.allclose(centre, camera.undistorted().project(point[None])[0][0], atol=0.3)


def test_image_of_another_size_raises():
    with pytest.raises(ValueError, match="640x480"):
        Undistorter(PLUMB)(np.zeros((240, 320), np.uint8))
