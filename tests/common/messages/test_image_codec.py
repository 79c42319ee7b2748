"""All encodings of an image decode to the same RGB; invalid bytes raise UserError."""

import cv2
import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.messages.image_codec import decode_rgb

RGB = np.random.default_rng(3).integers(0, 255, (6, 8, 3)).astype(np.uint8)
RGBA = np.dstack([RGB, np.full((6, 8), 255, np.uint8)])


@pytest.mark.parametrize(
    ("encoding", "image"),
    [("rgb8", RGB), ("bgr8", RGB[..., ::-1]), ("rgba8", RGBA), ("bgra8", RGBA[..., [2, 1, 0, 3]])],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_raw_encodings(encoding, image, padding):
    rows = np.ascontiguousarray(image).reshape(6, -1)
    padded = np.pad(rows, ((0, 0), (0, padding)))
    decoded = decode_rgb(padded.reshape(-1), encoding, 8, 6, padded.shape[1] if padding else 0)
    np.testing.assert_array_equal(decoded, RGB)


def test_grey_and_png():
    grey = RGB[..., 0].copy()
    np.testing.assert_array_equal(decode_rgb(grey.reshape(-1), "mono8", 8, 6)[..., 1], grey)
    png = cv2.imencode(".png", RGB[..., ::-1])[1].reshape(-1)
    np.testing.assert_array_equal(decode_rgb(png, "png", 8, 6), RGB)


@pytest.mark.parametrize(
    ("least_width_px", "size"),
    [(None, (250, 161)), (126, (250, 161)), (125, (125, 81)), (40, (63, 41)), (9, (32, 21))],
)
def test_a_jpeg_is_decoded_at_the_smallest_sufficient_size(least_width_px, size):
    ramp = np.linspace(0, 255, 250)[None, :, None] * np.ones((161, 1, 3)) * np.array([1.0, 0.5, 0.0])
    jpeg = cv2.imencode(".jpg", ramp[..., ::-1].astype(np.uint8))[1].reshape(-1)
    decoded = decode_rgb(jpeg, "jpeg", 250, 161, least_width_px=least_width_px)
    assert decoded.shape == (*size[::-1], 3)
    expected = cv2.resize(ramp, size, interpolation=cv2.INTER_AREA)
    assert np.abs(decoded - expected).mean() < 3.0
    png = cv2.imencode(".png", RGB[..., ::-1])[1].reshape(-1)
    assert decode_rgb(png, "png", 8, 6, least_width_px=1).shape == (6, 8, 3)  # PNG has no smaller sizes


@pytest.mark.parametrize(
    ("data", "encoding", "message"),
    [
        (np.zeros(0, np.uint8), "jpeg", "0 bytes do not decode"),
        (np.arange(200, dtype=np.uint8), "jpeg", "do not decode as jpeg"),
        (cv2.imencode(".jpg", RGB)[1].reshape(-1), "jpeg", "is 8x6, not 9x6"),
        (np.zeros(100, np.uint8), "rgb8", "truncated: 100 bytes for 9x6 rgb8"),
    ],
)
def test_invalid_bytes_raise_user_error(data, encoding, message):
    with pytest.raises(UserError, match=message):
        decode_rgb(data, encoding, 9, 6)
