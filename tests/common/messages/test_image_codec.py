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
