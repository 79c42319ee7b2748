"""Compact encoding of health reports, for links where bytes are scarce.

    zstd frame of msgpack: [version of Health, report, report, ...]

A report is the list of its values in the order of the fields of `Health`; the entries of `inputs`, `outputs`,
`rejected` and `figures` are such lists too. Fields are only added at the end of a class, so that a reader of
another minor version ignores the values that it does not know, and uses defaults for those that are missing.
Numbers with a fraction are rounded to `_DIGITS` significant digits; all others are exact.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import msgpack
import numpy as np
import zstandard

from beamsplat.common.messages.robot import Health, InputHealth, NodeFigure, OutputHealth, Rejected
from beamsplat.common.messages.schema import MessagePart

_DIGITS = 4
_LEVEL = 9  # of zstd; some kilobytes once a second
_MAX_BYTES = 1_000_000  # of all reports, decompressed
_MAX_FLOAT32 = 3.4e38
_MAX_ENTRIES = 1000  # reports, and values of one list
_PARTS: dict[str, type[MessagePart]] = {
    "inputs": InputHealth, "outputs": OutputHealth, "rejected": Rejected, "figures": NodeFigure,
}  # fmt: skip
_MAJOR = Health.version.partition(".")[0]


def pack_reports(reports: Iterable[Health]) -> np.ndarray:
    """Encode health reports as bytes uint8 [B]."""
    rows = [[_packed(getattr(health, name), name) for name in Health.model_fields] for health in reports]
    content = msgpack.packb([Health.version, *rows], use_single_float=True)
    return np.frombuffer(zstandard.ZstdCompressor(level=_LEVEL).compress(content), np.uint8)


def _packed(value: Any, name: str) -> Any:
    if name in _PARTS:
        return [[_short(getattr(part, field)) for field in _PARTS[name].model_fields] for part in value]
    return _short(value)


def _short(value: Any) -> Any:
    """Return a number with few digits, as an integer where it is one."""
    if not isinstance(value, float) or not math.isfinite(value):
        return value
    short = value if value.is_integer() else float(f"{value:.{_DIGITS}g}")
    if short.is_integer() and abs(short) < 2.0**63:
        return int(short)
    return min(max(short, -_MAX_FLOAT32), _MAX_FLOAT32)


def unpack_reports(packed: np.ndarray) -> list[Health]:
    """Decode the bytes uint8 [B] of `pack_reports`.

    Raises:
        ValueError: the bytes are damaged, of another major version of `Health`, or a value is invalid.
    """
    try:
        # Read first: zstd allocates what a frame states, which can be gigabytes.
        if not 0 < zstandard.frame_content_size(packed.data) <= _MAX_BYTES:
            raise ValueError(f"health reports of more than {_MAX_BYTES} bytes, or of unknown size")
        content = zstandard.ZstdDecompressor().decompress(packed.data)
        version, *rows = msgpack.unpackb(
            content, max_array_len=_MAX_ENTRIES, max_map_len=0, max_ext_len=0, max_bin_len=0
        )
        if str(version).partition(".")[0] != _MAJOR:
            raise ValueError(f"health reports of version {str(version)[:12]}, expected {Health.version}")
        return [Health.model_validate(_fields(Health, row)) for row in rows]
    except (zstandard.ZstdError, msgpack.UnpackException, TypeError, OverflowError) as error:
        raise ValueError(f"no health reports: {str(error)[:200] or type(error).__name__}") from error


def _fields(part: type[MessagePart], row: list[Any]) -> dict[str, Any]:
    fields = dict(zip(part.model_fields, row))
    for name in _PARTS.keys() & fields.keys() if part is Health else ():
        fields[name] = tuple(_fields(_PARTS[name], entry) for entry in fields[name])
    return fields
