"""Encoding and size of a compressed image from its first bytes, without decoding its pixels."""

from __future__ import annotations

import struct
from typing import Literal, NamedTuple

_PNG = b"\x89PNG\r\n\x1a\n"
# Start-of-frame markers: C0..CF without C4 (Huffman table), C8 (reserved) and CC (arithmetic table).
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


class ImageHeader(NamedTuple):
    """Encoding and size in pixels of a compressed image."""

    encoding: Literal["jpeg", "png"]
    width_px: int
    height_px: int


def read_image_header(data: bytes | memoryview) -> ImageHeader | None:
    """Return encoding and size of a JPEG or PNG; None for other formats and truncated headers."""
    head = memoryview(data)
    if bytes(head[:8]) == _PNG and len(head) >= 24:
        width, height = struct.unpack_from(">II", head, 16)
        return ImageHeader("png", width, height)
    if bytes(head[:2]) == b"\xff\xd8":
        return _jpeg(head)
    return None


def _jpeg(data: memoryview) -> ImageHeader | None:
    """Search the segments of a JPEG for its frame header (ITU-T T.81, B.1 and B.2.2)."""
    position = 2
    while position + 9 <= len(data):
        if data[position] != 0xFF:
            return None
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
        elif marker == 0x01 or 0xD0 <= marker <= 0xD7:  # stand-alone markers
            position += 2
        elif marker in _START_OF_FRAME:
            height, width = struct.unpack_from(">HH", data, position + 5)
            return ImageHeader("jpeg", width, height)
        else:
            position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    return None


def is_complete_image(data: bytes | memoryview) -> bool:
    """Return whether a JPEG or PNG has a header and an end marker, so that it is not truncated.

    Zeros after the end marker are allowed, because cameras pad their buffers. Bytes between are not checked.
    """
    view = memoryview(data)
    head = read_image_header(view)
    if head is None:
        return False
    tail = bytes(view[-4096:]).rstrip(b"\0")
    if head.encoding == "png":
        return bytes(view[-16:]).find(b"IEND") >= 0
    return tail.endswith(b"\xff\xd9")
