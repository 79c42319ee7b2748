"""The stated standard deviation of depth: it includes gross errors, and the mapper takes them out again."""

import numpy as np
import pytest

from beamsplat.common.geometry.depth_sigma import OF_KEYFRAMES, stated_sigma_log, typical_sigma_m


def test_the_stated_sigma_is_the_rms_of_right_and_wrong_surfaces():
    rng = np.random.default_rng(0)
    typical = np.full(200_000, 0.06)
    share = 0.06**2 / (0.06**2 + OF_KEYFRAMES.half**2)
    wrong = rng.random(len(typical)) < share
    errors = rng.normal(0.0, 0.06, len(typical)) + wrong * rng.normal(0.0, OF_KEYFRAMES.size, len(typical))
    assert stated_sigma_log(typical, OF_KEYFRAMES)[0] == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.03)


def test_the_typical_sigma_comes_back():
    typical = np.geomspace(0.003, 1.0, 60).astype(np.float32)
    depth = np.linspace(0.4, 12.0, 60).astype(np.float32)
    stated = depth * stated_sigma_log(typical, OF_KEYFRAMES)
    assert np.all(np.diff(stated / depth) > 0.0)
    np.testing.assert_allclose(typical_sigma_m(depth, stated), depth * typical, rtol=2e-3)


def test_less_than_any_pixel_has_is_zero_and_unknown_stays_unknown():
    depth = np.array([2.0, np.nan], np.float32)
    found = typical_sigma_m(depth, np.array([0.001, np.nan], np.float32))
    assert found[0] == 0.0
    assert np.isnan(found[1])
