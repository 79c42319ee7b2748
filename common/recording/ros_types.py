"""ROS 2 message types: definitions, construction, serialisation, frame names, time stamps."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from beamsplat.common.geometry.transforms import make_transform, matrix_from_quat_wxyz, quat_xyzw_from_matrix

# Frame names of REP 103 and REP 105, which RViz, nav2 and Foxglove expect.
FRAME_MAP = "map"
FRAME_ODOM = "odom"
FRAME_BODY = "base_link"
FRAME_LIDAR = "laser"
FRAME_CAMERA = "camera_optical_frame"

# Not part of the distribution that `typestore` describes: nav2 and RViz read changed parts of a map with it.
GRID_UPDATE = "map_msgs/msg/OccupancyGridUpdate"
_GRID_UPDATE_FIELDS = "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data\n"

_SEC_LIMIT = 2**31  # builtin_interfaces/Time counts seconds in an int32


@cache
def typestore() -> Typestore:
    """Return the message definitions of ROS 2 Jazzy; the types used here are the same in Humble."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(_GRID_UPDATE_FIELDS, GRID_UPDATE))
    return store


@cache
def definition(type_name: str) -> bytes:
    """Return the text definition of a ROS type and the types in it, as in MCAP's `ros2msg` schema."""
    return typestore().generate_msgdef(type_name, ros_version=2)[0].encode()


def new(type_name: str, **fields: Any) -> Any:
    """Create an instance of a ROS type: new("std_msgs/msg/Header", stamp=..., frame_id=...)."""
    return typestore().types[type_name](**fields)


def serialize(message: Any) -> bytes:
    """Return a ROS message as CDR bytes, little endian."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def time_of(stamp_ns: int) -> Any:
    """Return a stamp (ns) as builtin_interfaces/Time; stamps after 2038 are clipped to the int32 maximum.

    The writer of recordings detects a clipped stamp and stores the exact one in a "fields" record.
    """
    sec, nanosec = divmod(stamp_ns, 10**9)
    return new("builtin_interfaces/msg/Time", sec=min(sec, _SEC_LIMIT - 1), nanosec=nanosec)


def header(stamp_ns: int, frame_id: str) -> Any:
    """Return a std_msgs/Header with this stamp (ns) and frame name."""
    return new("std_msgs/msg/Header", stamp=time_of(stamp_ns), frame_id=frame_id)


def stamp_ns_of(time: Any) -> int:
    """Return a ROS 1 or ROS 2 time in nanoseconds."""
    return int(time.sec) * 10**9 + int(time.nanosec)


def vector(values: np.ndarray) -> Any:
    """Return a vector [3] as geometry_msgs/Vector3."""
    x, y, z = (float(v) for v in values)
    return new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def quaternion(R: np.ndarray) -> Any:
    """Return a rotation matrix [3, 3] as geometry_msgs/Quaternion."""
    x, y, z, w = (float(v) for v in quat_xyzw_from_matrix(R))
    return new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def pose(T: np.ndarray) -> Any:
    """Return a transform [4, 4] as geometry_msgs/Pose."""
    x, y, z = (float(v) for v in T[:3, 3])
    position = new("geometry_msgs/msg/Point", x=x, y=y, z=z)
    return new("geometry_msgs/msg/Pose", position=position, orientation=quaternion(T[:3, :3]))


def tf(stamp_ns: int, parent: str, child: str, T_parent_child: np.ndarray) -> Any:
    """Return a transform [4, 4] as geometry_msgs/TransformStamped, with its stamp (ns) and frame names."""
    transform = new(
        "geometry_msgs/msg/Transform",
        translation=vector(T_parent_child[:3, 3]),
        rotation=quaternion(T_parent_child[:3, :3]),
    )
    return new(
        "geometry_msgs/msg/TransformStamped",
        header=header(stamp_ns, parent), child_frame_id=child, transform=transform,
    )  # fmt: skip


def tf_message(transforms: list[Any]) -> Any:
    """Return a list of TransformStamped as tf2_msgs/TFMessage."""
    return new("tf2_msgs/msg/TFMessage", transforms=transforms)


def transform_of(position: Any, orientation: Any) -> np.ndarray:
    """Return the transform [4, 4] of a ROS position (or translation) and orientation.

    Raises:
        ValueError: the quaternion is zero or not finite.
    """
    quat_wxyz = np.array([orientation.w, orientation.x, orientation.y, orientation.z])
    return make_transform(matrix_from_quat_wxyz(quat_wxyz), np.array([position.x, position.y, position.z]))


# Exceptions that rosbags' generated deserialisers raise on invalid bytes.
_DESERIALISE_ERRORS = (
    SerdeError,
    ValueError,
    struct.error,
    IndexError,
    AssertionError,
    OverflowError,
    MemoryError,
    TypeError,
)


def deserialize(data: bytes, type_name: str) -> Any:
    """Decode CDR bytes to the ROS message of type `type_name`.

    Raises:
        ValueError: the bytes are not a message of this type.
    """
    try:
        return typestore().deserialize_cdr(data, type_name)
    except _DESERIALISE_ERRORS as error:
        raise ValueError(f"not a {type_name}: {error}") from error
