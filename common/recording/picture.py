"""Size and kind of a compressed picture from its first bytes; pixels are never decoded."""

from __future__ import annotations

import struct
from typing import Literal, NamedTuple

_PNG = b"\x89PNG\r\n\x1a\n"
# Start-of-frame markers: C0..CF without C4 (Huffman table), C8 (reserved) and CC (arithmetic table).
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


class Picture(NamedTuple):
    """What the head of a compressed picture says."""

    encoding: Literal["jpeg", "png"]
    width_px: int
    height_px: int


def picture_head(data: bytes | memoryview) -> Picture | None:
    """Kind and size of a JPEG or PNG; None for anything else or a head that is cut short."""
    head = memoryview(data)
    if bytes(head[:8]) == _PNG and len(head) >= 24:
        width, height = struct.unpack_from(">II", head, 16)
        return Picture("png", width, height)
    if bytes(head[:2]) == b"\xff\xd8":
        return _jpeg(head)
    return None


def _jpeg(data: memoryview) -> Picture | None:
    """Walks the segments to the frame header (ITU-T T.81, B.1 and B.2.2)."""
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
            return Picture("jpeg", width, height)
        else:
            position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    return None


def is_whole(data: bytes | memoryview) -> bool:
    """Whether a JPEG or PNG has its beginning and its end, so that nothing was cut off.

    Cameras pad their buffers: zeros may follow the end mark. Wrong bytes between are not looked for.
    """
    view = memoryview(data)
    head = picture_head(view)
    if head is None:
        return False
    tail = bytes(view[-4096:]).rstrip(b"\0")
    if head.encoding == "png":
        return bytes(view[-16:]).find(b"IEND") >= 0
    return tail.endswith(b"\xff\xd9")
