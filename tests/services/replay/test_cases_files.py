"""Bag files as recorders, tools and accidents leave them: read as far as they go, and what is missing is said."""

import shutil
import struct

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from beamsplat.common.errors import UserError
from beamsplat.services.replay.bags import Bag
from beamsplat.services.replay.inspection import inspect
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.source import open_source
from tests.services.replay.make_bags import START_NS, Drive, write_bag

LIDAR = Drive(seconds=10.0, images="")


def rows(path):
    """Return (topic, type, receive time, data) of all messages of a bag."""
    with Bag(path) as bag:
        return [(m.topic, m.type_name, m.at_ns, m.data) for m in bag.messages()]


def scans(path, **options):
    """Return (number of scans, problems), and check that `info` says the same."""
    source = open_source(path, SourceOptions(**options))
    count = sum(topic == "lidar/scan" for _, topic, _ in source.messages())
    problems = source.problems
    source.close()
    report = inspect(path, SourceOptions(**options))
    assert report.error == ""
    assert set(problems) <= set(report.problems)
    return count, problems


def mcap(path, messages, compression=CompressionType.ZSTD, schema="ros2msg", encoding="cdr", chunk=2_000):
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk, compression=compression, enable_crcs=True)
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, kind, at, data in messages:
            if topic not in channels:
                number = writer.register_schema(kind, schema, b"")
                channels[topic] = writer.register_channel(topic, encoding, number)
            writer.add_message(channels[topic], at, data, at)
        writer.finish()
    return path


def records(data, position):
    """Yield (offset of the data's length, header fields, data length) of the records of a ROS 1 bag."""
    while position < len(data):
        (head,) = struct.unpack_from("<I", data, position)
        fields, at = {}, position + 4
        while at < position + 4 + head:
            (length,) = struct.unpack_from("<I", data, at)
            name, _, value = bytes(data[at + 4 : at + 4 + length]).partition(b"=")
            fields[name], at = value, at + 4 + length
        (length,) = struct.unpack_from("<I", data, at)
        yield at, fields, length
        position = at + 4 + length


def test_an_index_with_wrong_lengths_is_read_by_its_counts(tmp_path):
    """Case c01: index records that state 20 bytes an entry and hold 12."""
    path = write_bag(tmp_path, "ros1", LIDAR)
    data = bytearray(path.read_bytes())
    changed = 0
    for at, fields, _ in list(records(data, 13)):
        if fields[b"op"] == b"\4":
            struct.pack_into("<I", data, at, 20 * struct.unpack("<I", fields[b"count"])[0])
            changed += 1
    path.write_bytes(data)
    assert changed
    assert scans(path)[0] == 100


def test_format_1_2_of_ros_1(tmp_path):
    """Case c02: messages with topic, type and time in their headers, outside of chunks."""
    path = write_bag(tmp_path, "ros1", LIDAR)
    out = bytearray(b"#ROSRECORD V1.2\n")

    def record(fields, data):
        head = b"".join(struct.pack("<I", len(n) + 1 + len(v)) + n + b"=" + v for n, v in fields)
        out.extend(struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data)

    record([(b"index_pos", bytes(8)), (b"op", b"\3")], b" " * 4000)
    for topic, kind, at, data in rows(path):
        sec, nanosec = divmod(at, 10**9)
        fields = [
            (b"op", b"\2"), (b"topic", topic.encode()), (b"md5", b"*"),
            (b"type", kind.replace("/msg/", "/").encode()), (b"sec", struct.pack("<I", sec)),
            (b"nsec", struct.pack("<I", nanosec)),
        ]  # fmt: skip
        record(fields, data)
    old = tmp_path / "old.bag"
    old.write_bytes(out)
    assert rows(old) == rows(path)
    assert scans(old)[0] == 100
    old.write_bytes(out.replace(b"#ROSRECORD V1.2", b"#ROSRECORD V1.1"))
    with pytest.raises(UserError, match=r"format '#ROSRECORD V1.1' is not read .*rosbag filter"):
        Bag(old)


def test_a_message_whose_definition_has_changed_is_not_read_as_another(tmp_path):
    path = write_bag(tmp_path, "ros1", LIDAR)
    path.write_bytes(path.read_bytes().replace(b"90c7ef2dc6895d81024acba2ac42f369", b"0" * 32))
    assert "old definition of sensor_msgs/msg/LaserScan" in inspect(path, SourceOptions()).error


def test_a_recorder_that_crashed_leaves_a_file_without_index(tmp_path):
    path = write_bag(tmp_path, "ros1", LIDAR)
    active = tmp_path / "drive.bag.active"
    shutil.copy(path, active)
    count, problems = scans(active)  # case c20: complete, but never renamed
    assert count == 100
    assert "the recorder has not closed this file" in problems[0]
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + 10
    (index,) = struct.unpack_from("<Q", data, at)
    struct.pack_into("<Q", data, at, 0)
    active.write_bytes(data[: index - 1000])
    with pytest.raises(UserError, match=r"drive.bag.active: truncated: .*rosbag reindex .*allow_truncated"):
        Bag(active)
    count, problems = scans(active, allow_truncated=True)
    assert "truncated" in problems[0]


def test_what_rosbag_reindex_leaves_is_not_read_twice(tmp_path):
    """Case c20: X.orig.bag beside X.bag. Copies under other names are recognised by their messages."""
    path = write_bag(tmp_path, "ros1", LIDAR)
    shutil.copy(path, tmp_path / "drive.orig.bag")
    count, problems = scans(tmp_path)
    assert count == 100
    assert "drive.orig.bag is not read, beside drive.bag: left over from a repair" in problems[0]
    (tmp_path / "drive.orig.bag").rename(tmp_path / "copy.bag")
    count, problems = scans(tmp_path)
    assert count == 100
    assert "drive.bag has the same messages as copy.bag: not read" in problems[0]


def test_two_drives_of_the_same_time_in_a_folder_are_refused(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    one = write_bag(tmp_path / "a", "ros1", LIDAR)
    two = write_bag(tmp_path / "b", "ros1", Drive(seconds=9.0, images=""))
    shutil.copy(one, tmp_path / "one.bag")
    shutil.copy(two, tmp_path / "two.bag")
    shutil.rmtree(tmp_path / "a")
    shutil.rmtree(tmp_path / "b")
    with pytest.raises(UserError, match=r"one.bag and two.bag have the same topics .* give one file"):
        Bag(tmp_path)


@pytest.mark.parametrize("metadata", [True, False])
def test_a_compressed_split_of_which_one_half_was_played(tmp_path, metadata):
    """Case c12: bag_0.mcap beside bag_0.mcap.zstd, and bag_1.mcap.zstd; with and without metadata.yaml."""
    messages = rows(write_bag(tmp_path, "mcap", LIDAR))
    folder = tmp_path / "split"
    folder.mkdir()
    half = len(messages) // 2
    for number, part in enumerate((messages[:half], messages[half:])):
        plain = mcap(folder / f"bag_{number}.mcap", part)
        (folder / f"bag_{number}.mcap.zstd").write_bytes(zstandard.compress(plain.read_bytes()))
        if number:
            plain.unlink()
    if metadata:
        (folder / "metadata.yaml").write_text(
            "rosbag2_bagfile_information:\n  version: 12\n  compression_mode: FILE\n  relative_file_paths:\n"
            "    - bag_0.mcap.zstd\n    - bag_1.mcap.zstd\n    - bag_2.mcap.zstd\n  duration: 1\n"
        )
    count, problems = scans(folder)
    assert count == 100
    assert "bag_0.mcap.zstd is not read, beside bag_0.mcap: the same file, compressed" in problems[0]
    lists = [p for p in problems if "metadata.yaml lists bag_2.mcap.zstd, which is not there" in p]
    assert len(lists) == metadata


def test_sqlite_splits_of_any_version_of_the_metadata(tmp_path):
    path = write_bag(tmp_path, "sqlite", LIDAR)
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("version: 8", "version: 99"))
    assert scans(path)[0] == 100


def test_damaged_chunks_are_left_out_and_the_seconds_are_said(tmp_path):
    """Case c11."""
    messages = rows(write_bag(tmp_path, "mcap", LIDAR))
    file = mcap(tmp_path / "damaged.mcap", messages)
    with file.open("rb") as opened:
        chunks = make_reader(opened).get_summary().chunk_indexes
    data = bytearray(file.read_bytes())
    third = len(chunks) // 3
    lost_s = 0.0
    for chunk in chunks[third : third + 3]:
        at = chunk.chunk_start_offset + chunk.chunk_length // 2
        data[at : at + 40] = bytes(40)
        lost_s += (chunk.message_end_time - chunk.message_start_time) / 1e9
    file.write_bytes(data)
    count, problems = scans(file)
    assert 50 < count < 100
    assert f"3 damaged chunks were left out: {lost_s:.1f} s of" in problems[0]


def test_damaged_chunks_of_ros_1(tmp_path):
    path = write_bag(tmp_path, "ros1", Drive(seconds=60.0, images="rgb8"))
    data = bytearray(path.read_bytes())
    chunks = [at for at, fields, _ in records(data, 13) if fields[b"op"] == b"\5"]
    assert len(chunks) > 3
    data[chunks[1] + 8 : chunks[1] + 60] = b"\xff" * 52
    path.write_bytes(data)
    count, problems = scans(path)
    assert 300 < count < 600
    assert "1 damaged chunk was left out" in problems[0]


@pytest.mark.parametrize(("schema", "encoding"), [("protobuf", "protobuf"), ("jsonschema", "json")])
def test_messages_that_are_not_of_ros_are_named(tmp_path, schema, encoding):
    path = mcap(
        tmp_path / "foxglove.mcap",
        [("/lidar", "foxglove.LaserScan", START_NS + i, b"{}") for i in range(5)], schema=schema,
        encoding=encoding,
    )  # fmt: skip
    text = inspect(path, SourceOptions()).error
    assert "/lidar (foxglove.LaserScan)" in text
    assert f"encoded as {encoding}" in text
    assert "only those of ROS" in text
