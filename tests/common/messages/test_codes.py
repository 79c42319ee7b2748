"""Precision of the encodings of Gaussians, depth and masks; errors for invalid bytes."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from beamsplat.common.messages import FusedDepth
from beamsplat.common.messages.depth_codec import (
    _pack,
    depth_to_mm,
    pack_depth,
    pack_mask,
    pack_sigma,
    packed_shape,
    sigma_to_codes,
    unpack_depth,
    unpack_depth_mm,
    unpack_mask,
    unpack_sigma,
)
from beamsplat.common.messages.depth_png import depth_to_png, mask_to_png
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


def depth_map(shape=(30, 40), seed=1):
    """Depth in m, with a pixel each that is unknown, too far, behind the camera, infinite and 0.3 mm."""
    depth = np.random.default_rng(seed).uniform(0.2, 60.0, shape).astype(np.float32)
    depth.ravel()[:5] = np.nan, 90.0, -1.0, np.inf, 3e-4
    return depth


def test_depth_is_quantised_to_half_a_millimetre():
    depth = depth_map()
    back = unpack_depth(pack_depth(depth))
    assert np.isnan(back.ravel()[:5]).all()
    known = np.isfinite(back)
    assert known.sum() == depth.size - 5
    error_mm = np.abs(back[known].astype(float) - depth[known]) * 1e3
    assert 0.49 < error_mm.max() <= 0.504  # 60 m in float32 has steps of 0.004 mm


@settings(max_examples=40, deadline=None)
@given(hnp.arrays(np.uint16, hnp.array_shapes(min_dims=2, max_dims=2, max_side=30)))
def test_quantised_depth_and_codes_are_passed_on_without_loss(depth_mm):
    np.testing.assert_array_equal(unpack_depth_mm(_pack(depth_mm)), depth_mm)
    again = pack_depth(unpack_depth(_pack(np.minimum(depth_mm, 64_999))))
    np.testing.assert_array_equal(unpack_depth_mm(again), np.minimum(depth_mm, 64_999))
    codes = (depth_mm >> 8).astype(np.uint8)
    np.testing.assert_array_equal(sigma_to_codes(unpack_sigma(_pack(codes))), codes)
    assert packed_shape(_pack(codes)) == depth_mm.shape


def test_sigma_is_quantised_to_two_percent():
    sigma = np.geomspace(0.001, 60.0, 500).reshape(20, 25).astype(np.float32)
    sigma[0, :3] = np.nan, 0.0, -1.0
    back = unpack_sigma(pack_sigma(sigma))
    assert np.isnan(back[0, :3]).all()
    known = np.isfinite(back)
    assert known.sum() == sigma.size - 3
    assert np.abs(back[known] / sigma[known] - 1.0).max() < 0.023
    assert unpack_sigma(pack_sigma(np.full((1, 2), 1e9, np.float32))) == pytest.approx(60.1, abs=0.1)


def test_depth_of_a_room_takes_a_tenth_of_its_floats():
    """A floor and two walls with a step between them: 640 x 480 px, 1.2 MB as float32."""
    v, u = np.mgrid[:480, :640].astype(np.float32)
    floor = 0.45 * 530.0 / np.maximum(v - 240.0, 1e-3)
    wall = 3.0 / (1.0 - 0.4 * (u - 320.0) / 530.0)
    depth = np.minimum(np.where(v > 240.0, floor, np.inf), np.where(u > 400.0, wall + 0.8, wall))
    packed = pack_depth(depth)
    assert len(packed) < 0.1 * depth.nbytes
    assert np.abs(unpack_depth(packed) - depth).max() < 0.00051


def test_keyframes_of_earlier_versions_contain_pngs():
    depth, mask = depth_map(), np.random.default_rng(2).random((30, 40)) > 0.5
    png = depth_to_png(depth_to_mm(depth))
    np.testing.assert_array_equal(unpack_depth(png, depth.shape), unpack_depth(pack_depth(depth)))
    codes = sigma_to_codes(depth)
    png = cv2.imencode(".png", codes)[1].ravel()
    np.testing.assert_array_equal(unpack_sigma(png, depth.shape), unpack_sigma(pack_sigma(depth)))
    np.testing.assert_array_equal(unpack_mask(mask_to_png(mask), mask.shape), mask)
    for unpack_png in (unpack_depth, unpack_sigma, unpack_mask):
        with pytest.raises(ValueError, match="the image is 40x30, not 40x31"):
            unpack_png(mask_to_png(mask), (31, 40))
    with pytest.raises(ValueError, match="depth: expected a PNG of uint16"):
        unpack_depth(mask_to_png(mask), mask.shape)


def test_mask_round_trip():
    mask = np.random.default_rng(2).random((12, 17)) > 0.5
    assert np.array_equal(unpack_mask(pack_mask(mask), mask.shape), mask)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda b: b[:3], "depth: 3 bytes are too few"),
        (lambda b: b"X" + b[1:], "no depth map"),
        (lambda b: b[:-4], "depth: does not decompress"),
        (lambda b: b[:12], "depth: does not decompress"),
        (lambda b: b[:6] + b"\xff\xff\xff\xff" + b[10:], "65535x65535 pixels, at most"),
        (lambda b: b[:6] + b"\x1f\0\x28\0" + b[10:], "do not have 40x31 pixels"),
        (lambda b: b[:4] + b"\x01" + b[5:], "1 bytes per pixel and 40x30 pixels, expected 2"),
    ],
)
def test_damaged_depth_raises_with_a_reason(damage, words):
    packed = np.frombuffer(damage(pack_depth(depth_map()).tobytes()), np.uint8)
    with pytest.raises(ValueError, match=words):
        unpack_depth(packed)


@given(st.binary(max_size=80))
@settings(max_examples=300, deadline=None)
def test_random_depth_raises_value_errors_only(data):
    for head in (b"", b"BSZ1\2\0\3\0\4\0", b"\x89PNG\r\n\x1a\n"):
        packed = np.frombuffer(head + data, np.uint8)
        for read in (unpack_depth, unpack_sigma, unpack_mask):
            with pytest.raises(ValueError, match=r"depth|sigma|mask"):
                read(packed, (3, 4))


def test_depth_of_another_size_is_refused():
    packed = pack_depth(depth_map())
    assert packed_shape(packed) == (30, 40)
    with pytest.raises(ValueError, match="40x30 pixels, expected 2 and 41x30"):
        unpack_depth(packed, (30, 41))
    with pytest.raises(ValueError, match="H, W"):
        pack_depth(np.zeros((0, 3), np.float32))
    with pytest.raises(ValueError, match="depth is"):
        FusedDepth.of(depth_map(), depth_map((30, 41)), stamp_ns=1)


def test_a_fused_depth_returns_what_it_was_made_of():
    depth = depth_map()
    message = FusedDepth.of(depth, 0.1 * depth, stamp_ns=1)
    np.testing.assert_array_equal(message.depth_m, unpack_depth(pack_depth(depth)))
    np.testing.assert_array_equal(message.sigma_m, unpack_sigma(pack_sigma(0.1 * depth)))
    none = np.zeros((0, 0), np.float32)
    refused = FusedDepth.of(none, none, stamp_ns=1, status="no pose")
    assert refused.depth_m.shape == refused.sigma_m.shape == (0, 0)
    assert refused.depth.size == 0
