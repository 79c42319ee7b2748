"""The wire format of ROS 2 over Zenoh (rmw_zenoh_cpp): keys, attachments, liveliness tokens.

From rmw_zenoh's design document and its liveliness_utils.cpp and attachment_helpers.cpp:

    key         <domain>/<topic without outer slashes>/<pkg>::msg::dds_::<Type>_/<type hash>
    attachment  sequence (int64), source time in ns (int64), gid (length byte, 16 bytes)
    token       @ros2_lv/<domain>/<zid>/<node>/<entity>/<NN|MP|MS|SS|SC>/<enclave>/<namespace>/<node name>
                [/<topic>/<type>/<hash>/<qos>], with "/" within a part replaced by "%"

The type hash is that of REP 2011 ("RIHS01_" and 64 digits) from Iron on; Humble, which has none, writes
"TypeHashNotSupported" in keys and tokens. From Lyrical on, tokens of types with arrays are longer: they also
list the buffer backends of the endpoint (ros2/rmw_zenoh #930).

The module opens no session.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

import xxhash

LIVELINESS_PREFIX = "@ros2_lv"
NO_TYPE_HASH = "TypeHashNotSupported"  # of all types, in Humble
TYPE_HASH = "RIHS01_"  # first characters of a type hash, from Iron on
OWN_NODE = "beamsplat"  # name of the nodes of this system in the ROS graph
GID_BYTES = 16
_MOST_PARTS = 16  # of a token: three more than those that are known
_ATTACHMENT = struct.Struct("<qqB16s")
# The format of late 2024 contains the names of its fields, each after its length.
_NAMED_ATTACHMENT = struct.Struct("<B15sqB16sqB10sB16s")
_FIELD_NAMES = (b"sequence_number", b"source_timestamp", b"source_gid")


def mangle(name: str) -> str:
    """Return `name` with "/" replaced by "%", for use as one part of a liveliness token."""
    return name.replace("/", "%")


def demangle(part: str) -> str:
    """Return the name in a part of a liveliness token, with "%" replaced by "/" (inverse of `mangle`)."""
    return part.replace("%", "/")


def dds_type(ros_type: str) -> str:
    """Return the DDS type name: sensor_msgs/msg/LaserScan -> sensor_msgs::msg::dds_::LaserScan_."""
    package, _, name = ros_type.partition("/msg/")
    return f"{package}::msg::dds_::{name}_"


def ros_type(dds: str) -> str | None:
    """Return the ROS type name: sensor_msgs::msg::dds_::LaserScan_ -> sensor_msgs/msg/LaserScan.

    Return None if `dds` does not have this form.
    """
    package, separator, name = dds.partition("::msg::dds_::")
    return f"{package}/msg/{name[:-1]}" if separator and name.endswith("_") else None


def data_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """Return the key expression of a ROS topic's messages; `type_hash` may be "*" for a subscription."""
    return f"{domain}/{topic.strip('/')}/{dds_type(type_name)}/{type_hash}"


class RmwKey(NamedTuple):
    """The parts of the key on which rmw_zenoh publishes a ROS message."""

    domain: str
    topic: str  # with a leading slash
    type_name: str
    type_hash: str

    @staticmethod
    def parse(key: str) -> RmwKey | None:
        """Return the parts of `key`; None if `key` does not belong to a ROS message."""
        parts = key.split("/")
        type_name = ros_type(parts[-2]) if len(parts) >= 4 else None
        if type_name is None:
            return None
        return RmwKey(parts[0], "/" + "/".join(parts[1:-2]), type_name, parts[-1])


class RmwAttachment(NamedTuple):
    """The metadata that rmw_zenoh sends with each ROS message, as Zenoh's attachment."""

    sequence: int
    source_ns: int
    gid: bytes

    def pack(self) -> bytes:
        """Return the attachment: the 33 bytes that Zenoh's serializer writes for (int64, int64, bytes)."""
        return _ATTACHMENT.pack(self.sequence, self.source_ns, GID_BYTES, self.gid)

    @staticmethod
    def unpack(data: bytes) -> RmwAttachment | None:
        """Parse an attachment in the current format or in the format of late 2024.

        Return None for other formats; the message is valid without its attachment.
        """
        if len(data) == _ATTACHMENT.size:
            sequence, source_ns, length, gid = _ATTACHMENT.unpack(data)
            return RmwAttachment(sequence, source_ns, gid) if length == GID_BYTES else None
        if len(data) == _NAMED_ATTACHMENT.size:
            _, a, sequence, _, b, source_ns, _, c, length, gid = _NAMED_ATTACHMENT.unpack(data)
            if (a, b, c) == _FIELD_NAMES and length == GID_BYTES:
                return RmwAttachment(sequence, source_ns, gid)
        return None


def _is_number(text: str) -> bool:
    """Return whether `int` accepts a text of at most 18 digits; `isdigit` alone also accepts superscripts."""
    return text.isascii() and text.isdigit() and len(text) <= 18


def _is_topic(name: str) -> bool:
    """Return whether a topic's messages have a key: no empty part, and no wildcard of Zenoh."""
    return all(name.strip("/").split("/")) and not set(name) & set("*$?#")


def _is_hash(text: str) -> bool:
    """Return whether a text can be a type hash, and so a part of a key: letters, digits, underscores."""
    return text.isascii() and text.replace("_", "a").isalnum()


@dataclass(frozen=True)
class RmwQos:
    """The quality of service settings in a liveliness token, which omits settings with default values.

    The default values are rmw_zenoh's.
    """

    best_effort: bool = False
    transient_local: bool = False
    keep_all: bool = False
    depth: int = 42

    def text(self) -> str:
        """Return the settings as text for a token.

        The form is reliability:durability:history,depth:deadline:lifespan:liveliness, with the numbers of
        the enumerations in rmw/types.h.
        """
        reliability = "2" if self.best_effort else ""
        durability = "1" if self.transient_local else ""
        history = "2" if self.keep_all else ""
        depth = "" if self.depth == 42 else str(self.depth)
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"

    @staticmethod
    def parse(text: str) -> RmwQos | None:
        """Return the settings in the QoS part of a token; None if the text is invalid."""
        parts = text.split(":")
        if len(parts) < 6 or "," not in parts[2]:
            return None
        history, depth = parts[2].split(",")[:2]
        if depth and not _is_number(depth):
            return None
        return RmwQos(parts[0] == "2", parts[1] == "1", history == "2", int(depth) if depth else 42)


@dataclass(frozen=True)
class RmwEntity:
    """A node, publisher or subscription in the ROS graph, described by a liveliness token."""

    domain: int
    zid: str  # of the Zenoh session
    node_id: int
    entity_id: int
    kind: str  # NN: node, MP: publisher, MS: subscription
    node_name: str
    namespace: str = "/"
    enclave: str = "/"
    topic: str = ""
    type_name: str = ""
    type_hash: str = ""
    qos: RmwQos = RmwQos()
    extension: str = ""  # what follows the QoS, with its leading slash (Lyrical: buffer backends)

    def token(self) -> str:
        """Return the key of this entity's liveliness token."""
        parts = [
            LIVELINESS_PREFIX, str(self.domain), self.zid, str(self.node_id), str(self.entity_id), self.kind,
            mangle(self.enclave), mangle(self.namespace), mangle(self.node_name),
        ]  # fmt: skip
        if self.kind != "NN":
            parts += [mangle(self.topic), dds_type(self.type_name), self.type_hash, self.qos.text()]
        return "/".join(parts) + self.extension

    def gid(self) -> bytes:
        """Return the entity's global id, 16 bytes: the XXH3 hash (128 bits) of the token, low half first."""
        high_low = xxhash.xxh3_128_digest(self.token().encode())
        return high_low[8:][::-1] + high_low[:8][::-1]

    @staticmethod
    def parse(token: str) -> RmwEntity | None:
        """Return the entity described by `token`; None for unsupported tokens (services, other versions)."""
        parts = token.split("/")
        numbers = (parts[i] for i in (1, 3, 4))
        if len(parts) < 9 or parts[0] != LIVELINESS_PREFIX or not all(_is_number(n) for n in numbers):
            return None
        kind = parts[5]
        type_name: str | None
        qos: RmwQos | None
        if kind == "NN" and len(parts) == 9:
            topic, type_name, type_hash, qos = "", "", "", RmwQos()
        elif kind in ("MP", "MS") and 13 <= len(parts) <= _MOST_PARTS:
            topic, type_name, type_hash = demangle(parts[9]), ros_type(parts[10]), parts[11]
            qos = RmwQos.parse(parts[12])
            if type_name is None or qos is None or not (_is_topic(topic) and _is_hash(type_hash)):
                return None
        else:
            return None
        return RmwEntity(
            int(parts[1]), parts[2], int(parts[3]), int(parts[4]), kind, demangle(parts[8]),
            demangle(parts[7]), demangle(parts[6]), topic, type_name, type_hash, qos,
            "".join(f"/{part}" for part in parts[13:]),
        )  # fmt: skip
