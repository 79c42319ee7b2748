"""How a recording names and describes what it holds; docs/recordings.md is the long form.

Each of our messages becomes at most one ROS message (role "message"), one map of the fields ROS has no
room for (role "fields"), or, where ROS has no counterpart, its own bytes (role "own"). Channel
metadata ties them together and carries what the header says about the sender.
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
from beamsplat.common.messages.codec import schema_of
from beamsplat.common.messages.header import DecodeError, Header

LIBRARY = "beamsplat 1"
PROFILE = "ros2"
OWN_ENCODING = "x-beamsplat"  # head and arrays of common/codec.py
FIELDS_ENCODING = "msgpack"
OWN_PREFIX = "/beamsplat/"

ROLE, TOPIC, SCHEMA = "beamsplat.role", "beamsplat.topic", "beamsplat.schema"
# The JSON schema of our own channels rides in their metadata: an MCAP schema record of an encoding
# other than ROS's keeps rosbags, and tools built on it, from opening the whole file.
JSON_SCHEMA = "beamsplat.jsonschema"
NO_SCHEMA = 0
_SENDER = ("clock_id", "epoch", "producer", "instance")
_SEQUENCE_BITS = 32  # MCAP counts in a uint32; the rest rides in the channel's metadata


def sender_metadata(header: Header | None) -> dict[str, str]:
    """What all messages of one sender share; {} where there was no header."""
    if header is None:
        return {}
    metadata = {f"beamsplat.{name}": str(getattr(header, name)) for name in _SENDER}
    return metadata | {"beamsplat.sequence_high": str(header.sequence >> _SEQUENCE_BITS)}


def header_of(metadata: dict[str, str], stamp_ns: int, publish_ns: int, sequence: int) -> Header | None:
    """The header that `sender_metadata` was made from; None where there was none."""
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
    """The message class of "Scan/1.0".

    Raises:
        DecodeError: unknown name or another major version.
    """
    name, _, version = schema.partition("/")
    cls = MESSAGES.get(name)
    if cls is None or version.split(".")[0] != cls.version.split(".")[0]:
        raise DecodeError(f"this program does not read {schema[:80]!r}")
    return cls


def missing_fields(message: Message, carried: dict[str, Any]) -> dict[str, Any]:
    """Fields of `message` which `carried` lacks or holds with another value."""
    return {
        name: value
        for name, value in message.__dict__.items()
        if name not in carried or not _same(value, carried[name])
    }


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        # Bytes, not values: NaN equals NaN, and -0.0 is not 0.0.
        return (
            isinstance(b, np.ndarray)
            and (a.dtype, a.shape) == (b.dtype, b.shape)
            and a.tobytes() == b.tobytes()
        )
    return type(a) is type(b) and a == b


def pack_fields(fields: dict[str, Any]) -> bytes:
    """msgpack of some fields; an array is {"dtype", "shape", "data"}."""
    return msgpack.packb(fields, default=_pack_array)


def _pack_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.name, "shape": list(value.shape), "data": value.tobytes()}
    raise TypeError(f"{type(value).__name__} has no place in a recording")


def unpack_fields(data: bytes, cls: type[Message]) -> dict[str, Any]:
    """Fields packed by `pack_fields`, without those of a newer minor version.

    Raises:
        DecodeError: not such a map.
    """
    try:
        fields = msgpack.unpackb(data, use_list=False)
        return {
            name: _unpack_array(value) if isinstance(value, dict) else value
            for name, value in fields.items()
            if name in cls.model_fields
        }
    except (ValueError, TypeError, KeyError, AttributeError, msgpack.UnpackException) as error:
        raise DecodeError(f"fields of {cls.schema_name()}: {error}") from error


def _unpack_array(value: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(value["data"], np.dtype(value["dtype"])).reshape(value["shape"])


class _Schema(GenerateJsonSchema):
    """JSON schema in which an array is described by words: JSON has no bytes."""

    def handle_invalid_for_json_schema(self, schema: Any, error_info: str) -> JsonSchemaValue:
        return {"type": "object", "description": "numpy array"}


@cache
def json_schema(cls: type[Message]) -> str:
    """JSON schema that a recording embeds, with dtype and shape of each array."""
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
    """Every MessagePart class by name, to resolve the schema's $defs."""
    found: dict[str, type[MessagePart]] = {}
    pending = [MessagePart]
    while pending:
        for child in pending.pop().__subclasses__():
            found[child.__name__] = child
            pending.append(child)
    return found
