"""Lens distortion against OpenCV, and the noise of the image sensor."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.tools.simulator.camera import ImageSensor, distort, pixel_rays, undistort

K = np.array([[265.0, 0.0, 159.5], [0.0, 265.0, 119.5], [0.0, 0.0, 1.0]])
small = st.floats(-1.0, 1.0)


@settings(max_examples=60)
@given(small, small, small, small, small)
def test_every_pixels_ray_projects_back_onto_the_pixel_with_opencv(k1, k2, p1, p2, k3):
    lens = (-0.15 * abs(k1), 0.04 * k2, 0.003 * p1, 0.003 * p2, 0.01 * k3)  # none of them folds over
    rays = pixel_rays(40, 30, K * [[1 / 8], [1 / 8], [1]], lens)
    scaled = K * [[1 / 8], [1 / 8], [1]]
    pixels, _ = cv2.projectPoints(rays.reshape(-1, 3), np.zeros(3), np.zeros(3), scaled, np.array(lens))
    u, v = np.meshgrid(np.arange(40), np.arange(30))
    np.testing.assert_allclose(pixels.reshape(30, 40, 2), np.stack([u, v], axis=-1), atol=1e-6)


@settings(max_examples=50)
@given(st.lists(st.tuples(st.floats(-0.6, 0.6), st.floats(-0.45, 0.45)), min_size=1, max_size=20))
def test_undistort_inverts_distort(points):
    lens = (-0.28, 0.07, 0.001, -0.002, 0.0)
    ideal = np.array(points)
    np.testing.assert_allclose(undistort(distort(ideal, lens), lens), ideal, atol=1e-9)


def test_a_lens_that_folds_over_is_refused():
    with pytest.raises(ValueError, match="folds over"):
        pixel_rays(64, 48, K * [[0.2], [0.2], [1]], (-1.5, 0.0, 0.0, 0.0, 0.0))


def test_without_distortion_the_centre_of_a_pixel_is_its_integer_coordinate():
    rays = pixel_rays(320, 240, K)
    np.testing.assert_allclose(rays[100, 200], [(200 - 159.5) / 265.0, (100 - 119.5) / 265.0, 1.0])


def test_shot_noise_grows_with_light_and_the_same_seed_gives_the_same_bytes():
    sensor = ImageSensor(np.zeros((60, 80, 3), np.float32), noise=1.0, vignetting=0.0, quality=92)
    dark, light = np.full((60, 80, 3), 0.02, np.float32), np.full((60, 80, 3), 0.6, np.float32)
    image = sensor.develop(light, 1.0, np.random.default_rng(0))
    assert np.array_equal(image, sensor.develop(light, 1.0, np.random.default_rng(0)))

    def linear_noise(level):
        srgb = sensor.develop(np.full((60, 80, 3), level, np.float32), 1.0, np.random.default_rng(1)) / 255.0
        return np.std(((srgb + 0.055) / 1.055) ** 2.4)

    assert linear_noise(0.6) > 3.0 * linear_noise(0.02)
    assert linear_noise(0.6) == pytest.approx(np.sqrt(0.0009 * 0.6), rel=0.15)
    assert dark.mean() < light.mean()
