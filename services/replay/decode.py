"""Decoding of serialised ROS 1 and ROS 2 messages, or of their stamps only."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any, NamedTuple

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

# Exceptions of the generated deserialisers of rosbags on invalid data, besides its own error.
_DECODE_ERRORS = (
    SerdeError, ValueError, struct.error, IndexError, AssertionError, OverflowError, MemoryError, TypeError,
)  # fmt: skip


class RawMessage(NamedTuple):
    """One serialised message of a bag; `at_ns` is its receive time."""

    at_ns: int
    topic: str
    type_name: str  # pkg/msg/Type, also for ROS 1
    data: bytes
    encoding: str  # "cdr", "ros1", or an unsupported encoding


@cache
def _store(encoding: str) -> Typestore:
    if encoding != "ros1":
        return get_typestore(Stores.ROS2_JAZZY)
    store = get_typestore(Stores.ROS1_NOETIC)  # has no tf messages
    for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
        if name not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    return store


@cache
def ros1_encoding(type_name: str, md5: str) -> str:
    """Return "ros1", or another text if the definition of the type, by its MD5 sum, is not that of Noetic.

    Old bags have messages of the same name with other fields; read as Noetic's they would be wrong.
    """
    store = _store("ros1")
    if md5 == "*" or type_name not in store.types:
        return "ros1"
    known = store.generate_msgdef(type_name, ros_version=1)[1]
    return "ros1" if md5 == known else f"ros1 with an old definition of {type_name} (convert: rosbag fix)"


def can_decode(type_name: str, encoding: str) -> bool:
    """Return whether messages of this type and encoding can be decoded."""
    return encoding in ("cdr", "ros1") and type_name in _store(encoding).types


def deserialize(message: RawMessage) -> Any:
    """Return the ROS message as an object with the fields of its definition.

    Raises:
        ValueError: unknown type, or invalid data.
    """
    if not can_decode(message.type_name, message.encoding):
        raise ValueError(f"type {message.type_name} with encoding {message.encoding} is not supported")
    store = _store(message.encoding)
    read = store.deserialize_ros1 if message.encoding == "ros1" else store.deserialize_cdr
    try:
        return read(message.data, message.type_name)
    except _DECODE_ERRORS as error:
        raise ValueError(f"not a {message.type_name}: {error}") from error


@cache
def begins_with_header(type_name: str, encoding: str) -> bool:
    """Return whether messages of this type start with a std_msgs/Header."""
    if not can_decode(type_name, encoding):
        return False
    fields = _store(encoding).fielddefs[type_name][1]
    return bool(fields) and fields[0][1][1] == "std_msgs/msg/Header"


def header_stamp_ns(message: RawMessage) -> int | None:
    """Return the stamp of a message that begins with a header; None if the data are too short."""
    try:
        if message.encoding == "ros1":
            sec, nanosec = struct.unpack_from("<II", message.data, 4)  # after the sequence number
        else:  # after the CDR header, whose second byte is the byte order
            sec, nanosec = struct.unpack_from("<iI" if message.data[1] & 1 else ">iI", message.data, 4)
    except (struct.error, IndexError):
        return None
    return sec * 10**9 + nanosec
