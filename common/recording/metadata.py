"""The file metadata.yaml, with which ROS 2 reads a folder as a bag (format version 5: Humble and later)."""

from __future__ import annotations

from io import StringIO

from ruamel.yaml import YAML

_QOS = """- history: 1
  depth: {depth}
  reliability: 1
  durability: {durability}
  deadline:
    sec: 0
    nsec: 0
  lifespan:
    sec: 0
    nsec: 0
  liveliness: 1
  liveliness_lease_duration:
    sec: 0
    nsec: 0
  avoid_ros_namespace_conventions: false
"""


def metadata_yaml(file_name: str, topics: dict[str, tuple[str, int]], first_ns: int, last_ns: int) -> str:
    """Return the text of metadata.yaml for a bag with one MCAP file.

    Args:
        file_name: name of the MCAP file in the folder.
        topics: ROS topic -> (ROS type, message count). List ROS topics only: `ros2 bag play` creates a
            publisher for each topic.
        first_ns, last_ns: arrival times (ns) of the first and the last message.
    """
    span = {
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "duration": {"nanoseconds": last_ns - first_ns},
    }
    count = sum(number for _, number in topics.values())
    table = {
        "rosbag2_bagfile_information": {
            "version": 5,
            "storage_identifier": "mcap",
            **span,
            "message_count": count,
            "topics_with_message_count": [
                {"topic_metadata": _topic(name, type_name), "message_count": number}
                for name, (type_name, number) in sorted(topics.items())
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file_name],
            "files": [{"path": file_name, **span, "message_count": count}],
        }
    }
    text = StringIO()
    yaml = YAML(typ="safe")
    yaml.default_flow_style = False
    yaml.dump(table, text)
    return text.getvalue()


def qos_profiles(topic: str) -> str:
    """Return the QoS profile that a ROS topic's publisher offers, as YAML text.

    The metadata of the MCAP channel and metadata.yaml must contain the same text.
    """
    latched = topic == "/tf_static"  # durability transient local: late subscribers receive the last message
    return _QOS.format(depth=1 if latched else 10, durability=1 if latched else 2)


def _topic(name: str, type_name: str) -> dict[str, str]:
    return {
        "name": name,
        "type": type_name,
        "serialization_format": "cdr",
        "offered_qos_profiles": qos_profiles(name),
    }
