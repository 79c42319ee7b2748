"""Decoding of images whose bytes come from cameras, files and other hosts.

Image arrays are RGB everywhere in this project; only OpenCV calls use BGR. The header of a compressed image
is read before its pixels: an image of another size than stated is refused before memory is allocated for it.
"""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.messages.image_header import read_image_header
from beamsplat.common.messages.sensor_models import MAX_PIXELS

_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "yuv422_yuy2": 2}
_TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB, "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
}  # fmt: skip
_REDUCED = {8: cv2.IMREAD_REDUCED_COLOR_8, 4: cv2.IMREAD_REDUCED_COLOR_4, 2: cv2.IMREAD_REDUCED_COLOR_2}
_START_OF_SCAN = b"\xff\xda"
# Progressive JPEGs have about ten scans. The decoder visits all pixels once per scan, also of an empty scan.
_MAX_SCANS = 64


def decode_rgb(
    data: np.ndarray,  # uint8 [B]
    encoding: str,
    width_px: int,
    height_px: int,
    step_bytes: int = 0,  # row length of a raw encoding, padding included; 0 = no padding
    least_width_px: int | None = None,
) -> np.ndarray:
    """Decode the bytes of an image to RGB uint8 [H, W, 3].

    Args:
        least_width_px: a result of this width is sufficient: a JPEG is decoded at 1/2, 1/4 or 1/8 of its
            size (rounded up), if that is at least this wide, in a fraction of the time.

    Raises:
        UserError: the bytes are not an image of this encoding, or the image has another size, or more than
            `MAX_PIXELS` pixels.
    """
    if encoding in ("jpeg", "png"):
        reduced = _reduction(width_px, least_width_px) if encoding == "jpeg" else None
        if reduced is None:
            return decode_compressed(data, encoding, width_px, height_px, cv2.IMREAD_COLOR_RGB)
        bgr = decode_compressed(data, encoding, width_px, height_px, reduced)
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB, dst=bgr)
    row = width_px * _CHANNELS[encoding]
    step = step_bytes or row
    if step < row or len(data) < step * height_px:
        raise UserError(f"the image is truncated: {len(data)} bytes for {width_px}x{height_px} {encoding}")
    if encoding == "yuv422_yuy2" and width_px % 2:
        raise UserError(f"a yuv422_yuy2 image has an even width, not {width_px}")
    raw = data[: step * height_px].reshape(height_px, step)[:, :row].reshape(height_px, width_px, -1)
    return np.ascontiguousarray(raw) if encoding == "rgb8" else cv2.cvtColor(raw, _TO_RGB[encoding])


def _reduction(width_px: int, least_width_px: int | None) -> int | None:
    """Return OpenCV's flag for the smallest JPEG that is wide enough; None for the full size."""
    for factor, flag in _REDUCED.items():
        if least_width_px is not None and width_px >= factor * least_width_px:
            return flag
    return None


def decode_compressed(
    data: np.ndarray,  # uint8 [B]
    encoding: str,  # jpeg or png
    width_px: int,
    height_px: int,
    flags: int,  # cv2.IMREAD_...
) -> np.ndarray:
    """Decode a JPEG or PNG with `cv2.imdecode`; dtype and channels [H, W] or [H, W, C] depend on `flags`.

    An orientation in EXIF data is ignored: the pixels are returned as they are stored.

    Raises:
        UserError: as `decode_rgb`; only the header of the image is read then.
    """
    head = read_image_header(data.data)
    if head is None or head.encoding != encoding:
        raise UserError(f"the image's {len(data)} bytes do not decode as {encoding}")
    if (head.width_px, head.height_px) != (width_px, height_px):
        raise UserError(f"the image is {head.width_px}x{head.height_px}, not {width_px}x{height_px}")
    if width_px * height_px > MAX_PIXELS:
        raise UserError(f"the image is {width_px}x{height_px}: more than {MAX_PIXELS} pixels")
    if encoding == "jpeg" and data.tobytes().count(_START_OF_SCAN) > _MAX_SCANS:
        raise UserError(f"the image is a JPEG of more than {_MAX_SCANS} scans")
    try:  # K belongs to the pixels as they are stored, whatever the orientation in the EXIF data
        image = cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise UserError(f"the image's {len(data)} bytes do not decode as {encoding}: {error.err}") from error
    if image is None:
        raise UserError(f"the image's {len(data)} bytes do not decode as {encoding}")
    return image
