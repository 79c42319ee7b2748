"""Precision of the encodings of Gaussians, depth and masks; errors for invalid bytes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.common.messages.depth_png import (
    depth_from_png,
    depth_to_png,
    mask_from_png,
    mask_to_png,
    sigma_from_png,
    sigma_to_png,
)
from beamsplat.common.messages.splat_codec import pack, unpack


def gaussians(count, seed=0):
    rng = np.random.default_rng(seed)
    params = np.empty((14, count), np.float32)
    params[:3] = rng.uniform(-8.0, 8.0, (3, count))
    params[3:6] = rng.uniform(np.log(2e-4), np.log(2.0), (3, count))
    params[6:10] = rng.normal(size=(4, count))
    params[10] = rng.uniform(-4.0, 4.0, count)
    params[11:14] = rng.uniform(0.0, 1.0, (3, count))
    return params


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 400), st.integers(0, 2**31))
def test_packed_gaussians_round_trip_within_tolerance(count, seed):
    params = gaussians(count, seed)
    back = unpack(pack(params))
    assert back.shape == params.shape
    assert np.all(np.abs(back[:3] - params[:3]) < 2.5e-4)
    assert np.all(np.abs(back[3:6] - params[3:6]) < 0.025)
    dots = np.abs(np.sum(back[6:10] * params[6:10] / np.linalg.norm(params[6:10], axis=0), axis=0))
    assert np.all(2.0 * np.arccos(np.clip(dots, 0.0, 1.0)) < np.radians(1.0))
    opacity, was = 1 / (1 + np.exp(-back[10])), 1 / (1 + np.exp(-params[10]))
    assert np.all(np.abs(opacity - was) < 0.004)
    assert np.all(np.abs(back[11:14] - params[11:14]) < 0.003)


def test_packed_gaussians_take_17_bytes_each():
    assert len(pack(gaussians(10_000))) < 17 * 10_000 + 1000


@pytest.mark.parametrize(
    "damage", [lambda b: b[:10], lambda b: b[:-30], lambda b: b"X" + b[1:], lambda b: b[:40] + b"\0" * 40]
)
def test_damaged_packed_gaussians_raise(damage):
    blob = damage(pack(gaussians(100)).tobytes())
    with pytest.raises(ValueError, match="Gaussians"):
        unpack(np.frombuffer(blob, np.uint8))


def test_packed_gaussians_with_a_wrong_count_raise():
    blob = bytearray(pack(gaussians(100)).tobytes())
    blob[4:8] = (7_000_000).to_bytes(4, "little")
    with pytest.raises(ValueError, match="bytes for 7000000"):
        unpack(np.frombuffer(bytes(blob), np.uint8))


def test_depth_round_trip_within_half_a_millimetre():
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.2, 60.0, (30, 40)).astype(np.float32)
    depth[3, 4], depth[5, 6], depth[7, 8] = np.nan, 90.0, -1.0
    back = depth_from_png(depth_to_png(depth), depth.shape)
    assert np.isnan([back[3, 4], back[5, 6], back[7, 8]]).all()
    known = np.isfinite(back)
    assert known.sum() == 30 * 40 - 3
    assert np.abs(back[known] - depth[known]).max() <= 0.00051


def test_sigma_round_trip_within_two_percent():
    sigma = np.geomspace(0.001, 60.0, 500).reshape(20, 25).astype(np.float32)
    sigma[0, 3] = np.nan
    back = sigma_from_png(sigma_to_png(sigma), sigma.shape)
    assert np.isnan(back[0, 3])
    known = np.isfinite(back)
    assert np.abs(back[known] / sigma[known] - 1.0).max() < 0.023


def test_mask_round_trip_and_invalid_bytes_raise():
    mask = np.random.default_rng(2).random((12, 17)) > 0.5
    assert np.array_equal(mask_from_png(mask_to_png(mask), mask.shape), mask)
    for read in (depth_from_png, sigma_from_png, mask_from_png):
        with pytest.raises(ValueError, match="do not decode as png"):
            read(np.zeros(0, np.uint8), mask.shape)
        with pytest.raises(ValueError, match="do not decode as png"):
            read(np.arange(50, dtype=np.uint8), mask.shape)
    with pytest.raises(ValueError, match="depth: expected a PNG of uint16"):
        depth_from_png(mask_to_png(mask), mask.shape)
