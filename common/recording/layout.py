"""Layout of a recording: names, encodings and metadata of its MCAP channels. See docs/recordings.md.

A BeamSplat message is stored as one ROS message (role "message") and, where necessary, a map of the fields
that the ROS message does not have (role "fields"); or, if ROS has no such message type, as its own encoding
(role "own"). Channel metadata connects the records and contains the publisher's part of the header.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import msgpack
import numpy as np
from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue

from beamsplat.common.messages import MESSAGES, Array, Message, MessagePart
from beamsplat.common.messages.codec import DTYPES, MAX_ENTRIES, schema_of
from beamsplat.common.messages.header import DecodeError, Header

LIBRARY = "beamsplat 1"
PROFILE = "ros2"
OWN_ENCODING = "x-beamsplat"  # the encoding of common/messages/codec.py
FIELDS_ENCODING = "msgpack"
OWN_PREFIX = "/beamsplat/"

ROLE, TOPIC, SCHEMA = "beamsplat.role", "beamsplat.topic", "beamsplat.schema"
# The JSON schema of our own channels is stored in their metadata: rosbags, and tools that use it, cannot
# open a file that has an MCAP schema record with an encoding other than those of ROS.
JSON_SCHEMA = "beamsplat.jsonschema"
NO_SCHEMA = 0
_SENDER = ("clock_id", "epoch", "producer", "instance")
_SEQUENCE_BITS = 32  # MCAP's sequence is a uint32; the high bits are in the channel's metadata


def sender_metadata(header: Header | None) -> dict[str, str]:
    """Return the metadata of a publisher's MCAP channel: the header fields that its messages share.

    For a message without header (None) the metadata are empty.
    """
    if header is None:
        return {}
    metadata = {f"beamsplat.{name}": str(getattr(header, name)) for name in _SENDER}
    return metadata | {"beamsplat.sequence_high": str(header.sequence >> _SEQUENCE_BITS)}


def header_of(metadata: dict[str, str], stamp_ns: int, publish_ns: int, sequence: int) -> Header | None:
    """Return the header of a recorded message; None if the message was recorded without a header.

    Args:
        metadata: of the record's MCAP channel, from `sender_metadata`.
        stamp_ns: measurement time of the message.
        publish_ns: publish time of the record: publisher's monotonic clock.
        sequence: low 32 bits of the sequence number, as stored in the record.
    """
    if "beamsplat.producer" not in metadata:
        return None
    high = int(metadata["beamsplat.sequence_high"])
    return Header(
        stamp_ns=stamp_ns,
        publish_ns=publish_ns,
        clock_id=int(metadata["beamsplat.clock_id"]),
        sequence=sequence + (high << _SEQUENCE_BITS),
        epoch=int(metadata["beamsplat.epoch"]),
        producer=metadata["beamsplat.producer"],
        instance=metadata["beamsplat.instance"],
    )


def class_of(schema: str) -> type[Message]:
    """Return the message class of a schema name, for example `Scan` for "Scan/1.0".

    Raises:
        DecodeError: the name is unknown or the major version differs.
    """
    name, _, version = schema.partition("/")
    cls = MESSAGES.get(name)
    if cls is None or version.split(".")[0] != cls.version.split(".")[0]:
        raise DecodeError(f"this program does not support {schema[:80]!r}")
    return cls


def missing_fields(message: Message, carried: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of `message` that are missing in `carried` or have another value there, by name.

    `carried` contains the fields read back from the ROS message that represents `message`.
    """
    return {
        name: value
        for name, value in message.__dict__.items()
        if name not in carried or not _same(value, carried[name])
    }


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        # Compare bytes: NaN must equal NaN, and -0.0 must differ from 0.0.
        return (
            isinstance(b, np.ndarray)
            and (a.dtype, a.shape) == (b.dtype, b.shape)
            and a.tobytes() == b.tobytes()
        )
    return type(a) is type(b) and a == b


def pack_fields(fields: dict[str, Any]) -> bytes:
    """Return message fields encoded as msgpack; an array becomes {"dtype", "shape", "data"}."""
    return msgpack.packb(fields, default=_pack_array)


def _pack_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.name, "shape": list(value.shape), "data": value.tobytes()}
    raise TypeError(f"{type(value).__name__} cannot be encoded in a recording")


def unpack_fields(data: bytes, cls: type[Message]) -> dict[str, Any]:
    """Decode fields encoded by `pack_fields`; fields unknown to `cls` (of a newer version) are ignored.

    Raises:
        DecodeError: the bytes are not a valid result of `pack_fields`.
    """
    try:
        fields = msgpack.unpackb(data, use_list=False, max_array_len=MAX_ENTRIES, max_map_len=MAX_ENTRIES)
        return {
            name: _unpack_array(value) if isinstance(value, dict) else value
            for name, value in fields.items()
            if name in cls.model_fields
        }
    except (ValueError, TypeError, KeyError, AttributeError, msgpack.UnpackException) as error:
        raise DecodeError(f"fields of {cls.schema_name()}: {error}") from error


def _unpack_array(value: dict[str, Any]) -> np.ndarray:
    if value["dtype"] not in DTYPES:
        raise ValueError(f"array of {str(value['dtype'])[:80]!r}")
    return np.frombuffer(value["data"], value["dtype"]).reshape(value["shape"])


class _Schema(GenerateJsonSchema):
    """JSON schema generator that describes NumPy arrays in words, because JSON has no binary type."""

    def handle_invalid_for_json_schema(self, schema: Any, error_info: str) -> JsonSchemaValue:
        return {"type": "object", "description": "numpy array"}


@cache
def json_schema(cls: type[Message]) -> str:
    """Return the JSON schema of a message class that recordings embed, with dtype and shape of each array."""
    schema = cls.model_json_schema(schema_generator=_Schema)
    _describe_arrays(cls, schema)
    for name, part in schema.get("$defs", {}).items():
        _describe_arrays(_parts(cls)[name], part)
    schema["title"] = schema_of(cls)
    schema["$comment"] = (
        f"Message encoding {OWN_ENCODING}: uint32 length of a msgpack head, the head, padding to 64 bytes, "
        "then arrays, each padded to 64 bytes; in the head an array is extension type 1 with "
        f"[dtype, shape, offset]. Message encoding {FIELDS_ENCODING}: a map of only those fields that the "
        "ROS message with the same log time and sequence cannot hold; an array is {dtype, shape, data}."
    )
    return json.dumps(schema)


def _describe_arrays(cls: type[BaseModel], schema: dict[str, Any]) -> None:
    for name, field in cls.model_fields.items():
        array = next((entry for entry in field.metadata if isinstance(entry, Array)), None)
        if array is not None:
            schema["properties"][name] = {
                "type": "object",
                "description": f"array {array.dtype.name} {list(array.shape)}",
            }


def _parts(cls: type[BaseModel]) -> dict[str, type[MessagePart]]:
    """Return all MessagePart classes by name, to resolve the schema's $defs."""
    found: dict[str, type[MessagePart]] = {}
    pending = [MessagePart]
    while pending:
        for child in pending.pop().__subclasses__():
            found[child.__name__] = child
            pending.append(child)
    return found
