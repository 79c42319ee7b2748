"""Coloured points as `.e57` files: ASTM E2807, one scan in the map frame (metres, z up), without loss.

The file is a sequence of pages of 1024 bytes, each with a checksum. "Logical" offsets count the 1020 bytes of
content only, "physical" ones all bytes.
"""

from __future__ import annotations

import hashlib
import math
import struct
import uuid
from pathlib import Path

import numpy as np

from beamsplat.common.files.persist import write_atomically

_PAGE, _CONTENT = 1024, 1020  # bytes of a page, without its checksum
_CASTAGNOLI = 0x82F63B78  # polynomial of CRC-32C, bits reversed
_HEADER = struct.Struct("<8sIIQQQQ")  # signature, version, file length, XML offset and length, page size
_SECTION = struct.Struct("<B7xQQQ")  # kind, length, offsets of the data and of the index
_PACKET = struct.Struct("<BBHH")  # kind, flags, length - 1, number of streams
_INDEX = struct.Struct("<BBHHB9x")  # kind, flags, length - 1, number of entries, level
_INDEX_PACKET, _DATA_PACKET = 0, 1
_MAX_ENTRIES = 2048  # of an index
_POINTS = 2048  # per packet: 55 kB, of 64 allowed
_AXES, _COLOURS = ("X", "Y", "Z"), ("Red", "Green", "Blue")


def write_e57(path: Path, points_map_m: np.ndarray, colours: np.ndarray) -> None:
    """Write points float64 [N, 3] with colours uint8 [N, 3], atomically.

    Raises:
        ValueError: there are no points.
        OSError: the file cannot be written.
    """
    if len(points_map_m) == 0:
        raise ValueError("there are no points to be written")
    points = np.ascontiguousarray(points_map_m, "<f8")
    section = _section(points, colours, _HEADER.size)
    xml = _xml(points, colours, _HEADER.size).encode()
    xml_at = _HEADER.size + len(section)
    pages = math.ceil((xml_at + len(xml)) / _CONTENT)
    head = _HEADER.pack(b"ASTM-E57", 1, 0, pages * _PAGE, _physical(xml_at), len(xml), _PAGE)
    write_atomically(Path(path), _paged(head + section + xml))


def _physical(logical: int) -> int:
    """Return the offset in the file of a logical offset."""
    return logical + logical // _CONTENT * (_PAGE - _CONTENT)


def _section(points: np.ndarray, colours: np.ndarray, start: int) -> bytes:
    """Return the binary section with all points, for the logical offset `start`: data packets, then an index.

    A packet has one stream for each coordinate (8 bytes per point) and each colour (1 byte).
    """
    packets, offset = [], start + _SECTION.size
    entries: list[tuple[int, int]] = []  # number of the first point of a packet, physical offset
    for first in range(0, len(points), _POINTS):
        rows = slice(first, first + _POINTS)
        streams = [points[rows, axis].tobytes() for axis in range(3)]
        streams += [colours[rows, channel].tobytes() for channel in range(3)]
        body = struct.pack("<6H", *map(len, streams)) + b"".join(streams)
        body += bytes(-(_PACKET.size + len(body)) % 4)
        entries.append((first, _physical(offset)))
        packets.append(_PACKET.pack(_DATA_PACKET, 0, _PACKET.size + len(body) - 1, len(streams)) + body)
        offset += len(packets[-1])
    entries = entries[:: math.ceil(len(entries) / _MAX_ENTRIES)]
    size = _INDEX.size + 16 * len(entries)
    index = _INDEX.pack(_INDEX_PACKET, 0, size - 1, len(entries), 0)
    index += b"".join(struct.pack("<QQ", *entry) for entry in entries)
    length = offset + size - start
    head = _SECTION.pack(1, length, _physical(start + _SECTION.size), _physical(offset))
    return head + b"".join(packets) + index


def _xml(points: np.ndarray, colours: np.ndarray, section: int) -> str:
    """Return the description of the file; `section` is the logical offset of the points."""
    digest = hashlib.sha256(points.tobytes() + colours.tobytes()).hexdigest()
    scan_id, file_id = (uuid.uuid5(uuid.NAMESPACE_OID, digest + name) for name in ("scan", "file"))
    bounds = "".join(
        f'<{axis.lower()}Minimum type="Float">{low!r}</{axis.lower()}Minimum>'
        f'<{axis.lower()}Maximum type="Float">{high!r}</{axis.lower()}Maximum>'
        for axis, low, high in zip(_AXES, points.min(axis=0).tolist(), points.max(axis=0).tolist())
    )
    limits = "".join(
        f'<color{name}Minimum type="Integer">0</color{name}Minimum>'
        f'<color{name}Maximum type="Integer">255</color{name}Maximum>'
        for name in _COLOURS
    )
    fields = "".join(f'<cartesian{axis} type="Float"/>' for axis in _AXES)
    fields += "".join(f'<color{name} type="Integer" minimum="0" maximum="255"/>' for name in _COLOURS)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<e57Root type="Structure" xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0">
<formatName type="String"><![CDATA[ASTM E57 3D Imaging Data File]]></formatName>
<guid type="String"><![CDATA[{{{file_id}}}]]></guid>
<versionMajor type="Integer">1</versionMajor><versionMinor type="Integer">0</versionMinor>
<e57LibraryVersion type="String"><![CDATA[BeamSplat]]></e57LibraryVersion>
<coordinateMetadata type="String"/>
<data3D type="Vector" allowHeterogeneousChildren="1"><vectorChild type="Structure">
<guid type="String"><![CDATA[{{{scan_id}}}]]></guid>
<name type="String"><![CDATA[map]]></name>
<cartesianBounds type="Structure">{bounds}</cartesianBounds>
<colorLimits type="Structure">{limits}</colorLimits>
<points type="CompressedVector" fileOffset="{_physical(section)}" recordCount="{len(points)}">
<prototype type="Structure">{fields}</prototype>
<codecs type="Vector" allowHeterogeneousChildren="1"></codecs>
</points></vectorChild></data3D>
<images2D type="Vector" allowHeterogeneousChildren="1"></images2D>
</e57Root>
"""


def _paged(content: bytes) -> bytes:
    """Return the file: the content in pages, the last one filled with zeros, each with its checksum."""
    content += bytes(-len(content) % _CONTENT)
    pages = np.frombuffer(content, np.uint8).reshape(-1, _CONTENT)
    checksums = _crc32c(pages).astype(">u4")[:, None].view(np.uint8)
    return np.concatenate([pages, checksums], axis=1).tobytes()


def _crc32c(rows: np.ndarray) -> np.ndarray:
    """Return the CRC-32C uint32 [N] of each row of uint8 [N, M]."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(_CASTAGNOLI), table >> 1)
    crc = np.full(len(rows), 0xFFFFFFFF, np.uint32)
    for column in np.ascontiguousarray(rows.T):
        crc = table[(crc ^ column) & 0xFF] ^ (crc >> 8)
    return ~crc
