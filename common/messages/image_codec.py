"""Decoding of camera images. Image arrays are RGB everywhere in this project; only OpenCV calls use BGR."""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.errors import UserError

_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "yuv422_yuy2": 2}
_TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB, "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
}  # fmt: skip


def decode_rgb(
    data: np.ndarray,  # uint8 [B]
    encoding: str,
    width_px: int,
    height_px: int,
    step_bytes: int = 0,  # row length of a raw encoding, padding included; 0 = no padding
) -> np.ndarray:
    """Decode the bytes of an image to RGB uint8 [H, W, 3].

    Raises:
        UserError: the bytes are not an image of this encoding, or the image has another size.
    """
    if encoding in ("jpeg", "png"):
        bgr = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
        if bgr is None:
            raise UserError(f"the image's {len(data)} bytes do not decode as {encoding}")
        if bgr.shape[:2] != (height_px, width_px):
            raise UserError(f"the image is {bgr.shape[1]}x{bgr.shape[0]}, not {width_px}x{height_px}")
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    row = width_px * _CHANNELS[encoding]
    step = step_bytes or row
    if step < row or len(data) < step * height_px:
        raise UserError(f"the image is truncated: {len(data)} bytes for {width_px}x{height_px} {encoding}")
    raw = data[: step * height_px].reshape(height_px, step)[:, :row].reshape(height_px, width_px, -1)
    return np.ascontiguousarray(raw) if encoding == "rgb8" else cv2.cvtColor(raw, _TO_RGB[encoding])
