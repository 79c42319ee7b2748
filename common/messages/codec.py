"""Encoding of messages as bytes: a msgpack head, followed by raw arrays aligned to 64 bytes.

    uint32 head length | head (msgpack map) | padding | array 0 | padding | array 1 ...

In the head, an array is msgpack extension type 1 with [dtype, shape, offset]; offsets count from the end of
the padded head. pickle is not used, and decoded arrays are read-only views into the payload. The schema, for
example "Scan/1.0", is transmitted beside the payload, as Zenoh's encoding.
"""

from __future__ import annotations

import math
import struct
from functools import lru_cache
from typing import Any

import msgpack
import numpy as np
from pydantic import BaseModel

from beamsplat.common.messages import MESSAGES, Message
from beamsplat.common.messages.header import DecodeError

MEDIA_TYPE = "application/x-beamsplat"
_ALIGN = 64
_ARRAY = 1
DTYPES = frozenset(f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)) | {
    "bool", "float16", "float32", "float64",
}  # fmt: skip
_LENGTH = struct.Struct("<I")
# Limits of a received head. msgpack reserves a list of the stated length before it reads the entries, and
# lists can be nested: without limits a head of 1 MB reserves gigabytes of address space.
MAX_HEAD_BYTES = 1024 * 1024
MAX_ENTRIES = 256  # of a list or map; the longest of a message has 64
_MAX_DESCRIPTION_BYTES = 128  # of an array: dtype, shape, offset


def schema_of(message: Message | type[Message]) -> str:
    """Return name and version of a message or message class, for example "Scan/1.0"."""
    return f"{message.schema_name()}/{message.version}"


def encode(message: Message, keep: bool = False) -> bytes:
    """Return the payload of a message; its schema (`schema_of`) must be transmitted beside it.

    A message that was decoded, or encoded before with `keep`, is not encoded again.

    Args:
        keep: keep the payload with the message, for the next call: it is sent and stored, for example.

    Raises:
        ValueError: texts and numbers of the message exceed `MAX_HEAD_BYTES`; arrays do not count.
    """
    payload = kept_payload(message)
    if payload is None:
        payload = b"".join(_pieces(message))
        if keep:
            _keep(message, payload)
    return payload


def encode_into(message: Message, buffer: bytearray) -> bytes | bytearray:
    """Return the payload of a message as `encode` does: the one that is kept with it, or `buffer` with it.

    A buffer that is used again has its memory already; that of a new payload of a megabyte is 256 pages that
    the system must fill with zeros first.

    Args:
        buffer: its content and size are replaced.

    Raises:
        ValueError: see `encode`.
    """
    payload = kept_payload(message)
    if payload is not None:
        return payload
    pieces = _pieces(message)
    size = sum(map(_size, pieces))
    if len(buffer) < size:
        buffer.extend(bytes(size - len(buffer)))
    del buffer[size:]
    with memoryview(buffer) as view:
        position = 0
        for piece in pieces:
            end = position + _size(piece)
            if end > position:  # a view of nothing cannot be cast
                view[position:end] = memoryview(piece).cast("B")
            position = end
    return buffer


def _size(piece: bytes | memoryview) -> int:
    return piece.nbytes if isinstance(piece, memoryview) else len(piece)


def kept_payload(message: Message) -> bytes | None:
    """Return the payload that is kept with a message, of the schema `schema_of`; None without one."""
    return getattr(message, "kept_payload", None)


def _keep(message: Message, payload: bytes) -> None:
    object.__setattr__(message, "kept_payload", payload)  # messages are frozen


def _pieces(message: Message) -> list[bytes | memoryview]:
    """Return the parts of a payload, in order: head, padding, arrays."""
    arrays: list[np.ndarray] = []
    position = 0

    def pack(value: Any) -> Any:
        nonlocal position
        if isinstance(value, np.ndarray):
            description = msgpack.packb([value.dtype.name, list(value.shape), position])
            arrays.append(value)
            position += _padded(value.nbytes)
            return msgpack.ExtType(_ARRAY, description)
        if isinstance(value, BaseModel):
            return value.__dict__
        raise TypeError(f"{type(value).__name__} cannot be encoded in a message")

    head = msgpack.packb(message.__dict__, default=pack)
    if len(head) > MAX_HEAD_BYTES:
        raise ValueError(
            f"{schema_of(message)}: texts and numbers of {len(head)} bytes, at most {MAX_HEAD_BYTES}"
        )
    start = _padded(_LENGTH.size + len(head))
    pieces: list[bytes | memoryview] = [
        _LENGTH.pack(len(head)),
        head,
        bytes(start - _LENGTH.size - len(head)),
    ]
    for array in arrays:
        pieces.append(array.data)
        pieces.append(bytes(_padded(array.nbytes) - array.nbytes))
    return pieces


def decode(schema: str, payload: bytes) -> Message:
    """Decode and validate the message in `payload`; its arrays are read-only views into the payload.

    Of a newer minor version, fields unknown to this program are ignored. Messages of the older major versions
    that their class can read (`Message.oldest_major`) are converted. The payload is kept with a message of
    the current version, see `encode`.

    Raises:
        DecodeError: the schema is unknown or has another major version, the bytes are truncated or
            inconsistent, or a value is invalid. No other exception is raised, whatever the bytes.
    """
    cls, version = _class_of(schema)
    current = _version(cls)
    try:
        fields = _unpack(payload)
        if version[0] < current[0]:
            fields = cls.upgraded(version[0], fields)
        exact = version <= current and version[0] == current[0]  # no unknown fields are expected
        message = cls.model_validate(fields, extra=None if exact else "ignore")
        if version == current:
            _keep(message, payload)
        return message
    except DecodeError:
        raise
    # msgpack and pydantic raise ValueError; on malicious bytes they also raise the others.
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise DecodeError(f"{schema}: {_first_line(error)}") from error


@lru_cache(maxsize=256)
def _class_of(schema: str) -> tuple[type[Message], tuple[int, int]]:
    name, _, version = schema.partition("/")
    if name not in MESSAGES:
        raise DecodeError(f"unknown message {schema[:80]!r}")
    major, _, minor = version.partition(".")
    if not (major.isascii() and major.isdecimal() and minor.isascii() and minor.isdecimal()):
        raise DecodeError(f"{schema[:80]!r} has no version")
    newest = _version(MESSAGES[name])[0]
    oldest = MESSAGES[name].oldest_major or newest
    if len(version) > 12 or not oldest <= int(major) <= newest:
        raise DecodeError(
            f"{name} has version {version[:12]}, this program supports {MESSAGES[name].version}: "
            "update the older of the two programs"
        )
    return MESSAGES[name], (int(major), int(minor))


def _version(cls: type[Message]) -> tuple[int, int]:
    major, minor = cls.version.split(".")
    return int(major), int(minor)


def _unpack(payload: bytes) -> dict[str, Any]:
    if len(payload) < _LENGTH.size:
        raise DecodeError(f"payload of {len(payload)} bytes has no head")
    (head_length,) = _LENGTH.unpack_from(payload)
    start = _padded(_LENGTH.size + head_length)
    if _LENGTH.size + head_length > len(payload):
        raise DecodeError(f"head of {head_length} bytes in a payload of {len(payload)}")
    if head_length > MAX_HEAD_BYTES:
        raise DecodeError(f"head of {head_length} bytes, at most {MAX_HEAD_BYTES}")

    def view(code: int, description: bytes) -> np.ndarray:
        if code != _ARRAY:
            raise DecodeError(f"unknown extension type {code}")
        if len(description) > _MAX_DESCRIPTION_BYTES:
            raise DecodeError(f"description of an array has {len(description)} bytes")
        dtype, shape, offset = msgpack.unpackb(description)
        if dtype not in DTYPES or not isinstance(offset, int) or offset < 0 or len(shape) > 8:
            raise DecodeError(f"array of {dtype!r} at {offset!r}")
        if not all(isinstance(size, int) and 0 <= size < 2**40 for size in shape):
            raise DecodeError(f"array of shape {shape!r}")
        count = math.prod(shape)
        end = start + offset + count * np.dtype(dtype).itemsize
        if count and end > len(payload):
            raise DecodeError(f"array ends at byte {end} of {len(payload)}")
        if not count:
            return np.zeros(shape, dtype)
        return np.frombuffer(payload, dtype, count, start + offset).reshape(shape)

    head = memoryview(payload)[_LENGTH.size : _LENGTH.size + head_length]
    fields = msgpack.unpackb(
        head, ext_hook=view, use_list=False, strict_map_key=True,
        max_array_len=MAX_ENTRIES, max_map_len=MAX_ENTRIES,
    )  # fmt: skip
    if not isinstance(fields, dict):
        raise DecodeError(f"head is a {type(fields).__name__}, not a map")
    return fields


def _padded(size: int) -> int:
    return -(-size // _ALIGN) * _ALIGN


def _first_line(error: Exception) -> str:
    """Return field and reason of a pydantic error; its own text has several lines and quotes the input."""
    if hasattr(error, "errors"):
        first = error.errors(include_url=False, include_input=False)[0]
        return f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"
    return str(error).split("\n")[0][:200] or type(error).__name__
