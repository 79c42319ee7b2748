"""Check that a JPEG is complete: its segments, and for baseline JPEGs every Huffman code of every block.

A decoder fills damaged areas without an error. This check requires that a scan contains all its blocks and
ends at its end marker (ITU-T T.81, annexes C and F.2). It detects truncation, longer losses and several wrong
bytes. Of single wrong bytes it detects less than half, because Huffman decoding resynchronizes by itself and
JPEG has no checksum (detection rates in docs/sensors.md, measured by the test).
"""

from __future__ import annotations

import struct
from functools import lru_cache

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.common.messages.image_header import is_complete_image

_BASELINE = (0xC0, 0xC1)
_STAND_ALONE = frozenset([0x01, *range(0xD0, 0xD8)])


def is_intact(data: bytes) -> bool:
    """Return whether the check finds no damage in a JPEG."""
    if not data.startswith(b"\xff\xd8") or not is_complete_image(data):
        return False
    try:
        scan = _parse_segments(data)
    except (struct.error, IndexError, ValueError, KeyError):
        return False
    if scan is None:  # progressive, or without own Huffman tables: only the segment structure is checked
        return True
    start, tables, which, blocks, restart = scan
    stream = np.frombuffer(data, np.uint8)
    return bool(_decode_scan(stream, start, tables, which, blocks, restart))


def _parse_segments(
    data: bytes,
) -> tuple[int, np.ndarray, np.ndarray, int, int] | None:
    """Return the data required to decode the only scan of a baseline JPEG; None if it is not baseline.

    Returns:
        Offset of the first entropy-coded byte; Huffman tables uint16 [T, 65536]; indices of the (DC, AC)
        tables of each block of an MCU, int64 [B, 2]; number of MCUs; MCUs between restart markers (0: none).

    Raises:
        ValueError, KeyError, struct.error, IndexError: invalid segments.
    """
    at, restart = 2, 0
    codes: dict[int, np.ndarray] = {}
    frame: tuple[int, int, dict[int, tuple[int, int]]] | None = None
    while True:
        if data[at] != 0xFF:
            raise ValueError("a marker is missing")
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        if marker in _STAND_ALONE:
            at += 2
            continue
        length = struct.unpack_from(">H", data, at + 2)[0]
        body = data[at + 4 : at + 2 + length]
        if len(body) != length - 2:
            raise ValueError("a segment is truncated")
        if marker == 0xC4:
            _parse_huffman_tables(body, codes)
        elif marker in _BASELINE:
            frame = _parse_frame_header(body)
        elif 0xC2 <= marker <= 0xCF and marker not in (0xC8, 0xCC):
            return None
        elif marker == 0xDD:
            restart = struct.unpack(">H", body)[0]
        elif marker == 0xDA:
            if frame is None:
                raise ValueError("a scan header before the frame header")
            if not codes or body[0] != len(frame[2]):
                return None
            return (at + 2 + length, *_parse_scan_header(body, frame, codes), restart)
        at += 2 + length


def _parse_frame_header(body: bytes) -> tuple[int, int, dict[int, tuple[int, int]]]:
    """Return width and height (px), and the sampling factors (h, v) by component id."""
    height, width, count = struct.unpack_from(">HHB", body, 1)
    factors = {body[6 + 3 * i]: (body[7 + 3 * i] >> 4, body[7 + 3 * i] & 15) for i in range(count)}
    if not width or not height or not all(1 <= x <= 4 for pair in factors.values() for x in pair):
        raise ValueError("invalid size or sampling factors")
    return width, height, factors


def _parse_scan_header(
    body: bytes, frame: tuple[int, int, dict[int, tuple[int, int]]], codes: dict[int, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the Huffman tables, the table indices of each block of an MCU, and the number of MCUs."""
    width, height, factors = frame
    order = sorted(codes)
    which: list[tuple[int, int]] = []
    for i in range(body[0]):
        component, selector = body[1 + 2 * i], body[2 + 2 * i]
        h, v = factors[component] if body[0] > 1 else (1, 1)
        pair = order.index(selector >> 4), order.index(0x10 | selector & 15)
        which += [pair] * (h * v)
    h_most = max(h for h, _ in factors.values()) if body[0] > 1 else 1
    v_most = max(v for _, v in factors.values()) if body[0] > 1 else 1
    mcus = -(-width // (8 * h_most)) * -(-height // (8 * v_most))
    return np.stack([codes[key] for key in order]), np.array(which, np.int64), mcus


def _parse_huffman_tables(body: bytes, codes: dict[int, np.ndarray]) -> None:
    at = 0
    while at < len(body):
        counts = body[at + 1 : at + 17]
        symbols = body[at + 17 : at + 17 + sum(counts)]
        if len(counts) != 16 or len(symbols) != sum(counts):
            raise ValueError("a Huffman table is truncated")
        codes[body[at]] = _code_table(bytes(counts), bytes(symbols))
        at += 17 + len(symbols)


@lru_cache(maxsize=64)
def _code_table(counts: bytes, symbols: bytes) -> np.ndarray:
    """Return a lookup table that maps the next 16 bits of the stream to a Huffman code.

    Returns:
        uint16 [65536]: code length << 8 | symbol; 0 where the bits are no code.
    """
    table = np.zeros(65536, np.uint16)
    code = at = 0
    for length in range(1, 17):
        for _ in range(counts[length - 1]):
            first, beyond = code << (16 - length), (code + 1) << (16 - length)
            if beyond > 65536:
                raise ValueError("a Huffman table has too many codes")
            table[first:beyond] = length << 8 | symbols[at]
            code, at = code + 1, at + 1
        code <<= 1
    return table


@kernel
def _decode_scan(
    data: np.ndarray,  # uint8 [N]
    at: int,
    tables: np.ndarray,  # uint16 [T, 65536]
    which: np.ndarray,  # int64 [B, 2]
    mcus: int,
    restart: int,
) -> bool:
    """Decode all Huffman codes of a scan; return whether it ends exactly at the end marker."""
    n = data.shape[0]
    bits, have, marked = 0, 0, False
    due = 0
    for mcu in range(mcus):
        if restart > 0 and mcu > 0 and mcu % restart == 0:
            # The rest of the byte is filled with ones; then follows the restart marker with its number.
            if have >= 8 or at + 1 >= n or data[at] != 0xFF or data[at + 1] != 0xD0 + due:
                return False
            at, bits, have, marked = at + 2, 0, 0, False
            due = (due + 1) & 7
        for block in range(which.shape[0]):
            k = 0
            while k < 64:
                while have < 32 and not marked:
                    if at >= n:
                        return False
                    byte = int(data[at])
                    if byte == 0xFF:
                        if at + 1 >= n:
                            return False
                        if data[at + 1] != 0:
                            marked = True
                            break
                        at += 1
                    at += 1
                    bits = ((bits << 8) | byte) & 0xFFFFFFFFFF
                    have += 8
                if have >= 16:
                    peek = (bits >> (have - 16)) & 0xFFFF
                else:  # just before a marker: pad with ones
                    peek = ((bits << (16 - have)) | ((1 << (16 - have)) - 1)) & 0xFFFF
                entry = int(tables[which[block, 0 if k == 0 else 1], peek])
                length, symbol = entry >> 8, entry & 0xFF
                size = symbol & 15
                if length == 0 or length + size > have:
                    return False
                have -= length + size
                if k == 0:
                    if symbol > 11:
                        return False
                    k = 1
                elif size == 0:
                    if symbol == 0xF0:
                        k += 16
                    elif symbol == 0:
                        break
                    else:
                        return False
                else:
                    k += (symbol >> 4) + 1
                    if size > 10 or k > 64:
                        return False
    return have < 8 and at + 1 < n and data[at] == 0xFF and data[at + 1] == 0xD9


def warm() -> None:
    """Compile the kernel in advance, so that the first image is not delayed."""
    empty = np.zeros((1, 65536), np.uint16)
    _decode_scan(np.zeros(4, np.uint8), 0, empty, np.zeros((1, 2), np.int64), 1, 0)
