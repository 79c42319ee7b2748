from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from beamsplat.common.errors import UserError
from beamsplat.common.messages import MESSAGES, Anchors, Grid, Health, Image, Odometry, Scan, Tick
from beamsplat.common.messages.codec import decode, schema_of
from beamsplat.common.messages.header import Header
from beamsplat.common.messages.image_header import read_image_header
from beamsplat.common.recording import RecordingError, RecordingReader, RecordingWriter, is_recording
from beamsplat.common.recording.mcap_file import McapFile
from beamsplat.common.topics import TOPICS
from tests.common.messages.random_messages import assert_same, random_message
from tests.common.samples import sample_messages

TOPIC_OF = {row.message: name for name, row in TOPICS.items()}
TOPIC_OF[Grid] = "localization/grid"  # until version 0.2


def topic_of(message):
    return TOPIC_OF.get(type(message), "health/node")


def tick(i):
    return Tick(stamp_ns=i, count=i)


def scan(stamp_ns, beams=5):
    return Scan(
        stamp_ns=stamp_ns, angle_min_rad=-np.pi, angle_increment_rad=0.01, time_increment_s=1e-4,
        scan_time_s=0.1, range_min_m=0.1, range_max_m=12.0, ranges_m=np.full(beams, 2.0, np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("compression", list(CompressionType))
def test_all_messages_round_trip_bit_for_bit(tmp_path, compression):
    rng = np.random.default_rng(3)
    messages = [random_message(cls, rng) for _ in range(20) for cls in MESSAGES.values()] + sample_messages()
    with RecordingWriter(tmp_path / "rec", compression=compression, chunk_bytes=20_000) as writer:
        for i, message in enumerate(messages):
            writer.write(topic_of(message), message, 10**18 + i)
    with RecordingReader(tmp_path / "rec") as reader:
        recorded = list(reader.messages())
        assert reader.problems == []
        assert reader.counts == writer.counts
        assert (reader.start_ns, reader.end_ns) == (10**18, 10**18 + len(messages) - 1)
    assert len(recorded) == len(messages)
    for i, (message, back) in enumerate(zip(messages, recorded)):
        assert (back.topic, back.log_time_ns, back.header) == (topic_of(message), 10**18 + i, None)
        assert_same(back.message, message)


def test_headers_round_trip_with_64_bit_sequence(tmp_path):
    headers = [
        Header(5, 77, 2**64 - 1, 0, 1, "camera", "00112233445566ff"),
        Header(6, 78, 2**64 - 1, 1, 1, "camera", "00112233445566ff"),
        Header(7, 79, 2**64 - 1, 2**32 + 5, 1, "camera", "00112233445566ff"),
        Header(8, 80, 12, 0, 2, "caméra", "ff112233445566ff"),
    ]
    with RecordingWriter(tmp_path / "rec.mcap") as writer:
        for header in headers:
            writer.write("lidar/scan", scan(header.stamp_ns), 1000, header)
    with RecordingReader(tmp_path / "rec.mcap") as reader:
        assert [recorded.header for recorded in reader.messages()] == headers


def test_rosbags_and_mcap_read_the_recording(tmp_path):
    messages = sample_messages()
    with RecordingWriter(tmp_path / "rec") as writer:
        for i, message in enumerate(messages):
            writer.write(topic_of(message), message, i)
    with AnyReader([tmp_path / "rec"]) as bag:
        types = {connection.topic: connection.msgtype for connection in bag.connections}
        decoded = {c.topic: bag.deserialize(raw, c.msgtype) for c, _, raw in bag.messages()}
    assert types == {
        "/camera/image": "sensor_msgs/msg/Image",
        "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/lidar/scan": "sensor_msgs/msg/LaserScan",
        "/wheel/odometry": "nav_msgs/msg/Odometry",
        "/external/pose": "geometry_msgs/msg/PoseStamped",
        "/localization/odometry": "nav_msgs/msg/Odometry",
        "/localization/grid": "nav_msgs/msg/OccupancyGrid",
    }
    assert set(decoded) == set(types)
    assert decoded["/camera/camera_info"].k.tolist()[0] == 530.0
    assert decoded["/wheel/odometry"].twist.twist.linear.x == 0.3
    frames = {(t.header.frame_id, t.child_frame_id) for t in decoded["/tf_static"].transforms}
    assert frames == {("base_link", "camera_optical_frame"), ("base_link", "laser")}
    # The mcap package reads it too; channels of our own types have schema and payload.
    with (tmp_path / "rec" / "rec_0.mcap").open("rb") as stream:
        own = {
            channel.metadata["beamsplat.schema"]: (
                json.loads(channel.metadata["beamsplat.jsonschema"]),
                message,
            )
            for _, channel, message in make_reader(stream).iter_messages()
            if channel.message_encoding == "x-beamsplat"
        }
    assert set(own) >= {schema_of(Anchors), "Tick/1.0", schema_of(Health), "Rig/1.0"}
    schema, message = own[schema_of(Anchors)]
    assert schema["properties"]["T_map_anchor"]["description"] == "array float64 ['N', 4, 4]"
    anchors = next(m for m in messages if schema_of(m) == schema_of(Anchors))
    assert_same(decode(schema_of(Anchors), message.data), anchors)


def test_messages_are_filtered_by_topic_and_time(tmp_path):
    with RecordingWriter(tmp_path / "rec.mcap", chunk_s=0.0) as writer:
        for i in range(10):
            writer.write("tick", tick(i), i * 100)
            writer.write("lidar/scan", scan(i), i * 100 + 50)
    with RecordingReader(tmp_path / "rec.mcap") as reader:
        chosen = [r.message.stamp_ns for r in reader.messages(["lidar/scan"], start_ns=150, stop_ns=450)]
        assert chosen == [1, 2, 3]
        assert [r.log_time_ns for r in reader.messages(start_ns=900)] == [900, 950]


def test_messages_are_read_in_order_of_arrival(tmp_path):
    rng = np.random.default_rng(0)
    times = rng.permutation(500)
    with RecordingWriter(tmp_path / "rec.mcap", chunk_bytes=500) as writer:
        for time in times:
            writer.write("tick", tick(int(time)), int(time))
    with RecordingReader(tmp_path / "rec.mcap") as reader:
        assert [r.message.count for r in reader.messages()] == list(range(500))


def test_truncated_recording_is_read_to_its_last_complete_chunk(tmp_path):
    whole = tmp_path / "whole.mcap"
    with RecordingWriter(whole, chunk_bytes=4000) as writer:
        for i in range(200):
            writer.write("lidar/scan", scan(i, beams=50), i * 10**8)
    data = whole.read_bytes()
    with McapFile(whole) as file:
        ends = sorted(block.offset + block.length for block in file._blocks)
        last_end = {end: block.end_ns for end, block in zip(ends, file._blocks)}
    rng = np.random.default_rng(1)
    for cut in [
        *rng.integers(60, len(data) - 1, 40).tolist(),
        len(data) - 1,
        len(data) - 20,
        ends[3],
        ends[3] + 1,
    ]:
        part = tmp_path / "part.mcap"
        part.write_bytes(data[:cut])
        with RecordingReader(part) as reader:
            found = [r.message.stamp_ns for r in reader.messages()]
            assert len(reader.problems) == 1
            assert "part.mcap" in reader.problems[0]
            assert "bytes" in reader.problems[0] or "chunk" in reader.problems[0]
        kept = [last_end[end] for end in ends if end <= cut]
        assert found == list(range(kept[-1] // 10**8 + 1 if kept else 0))


def test_problem_text_states_the_duration_of_a_lost_chunk(tmp_path):
    whole = tmp_path / "whole.mcap"
    with RecordingWriter(whole, chunk_s=2.0) as writer:
        for i in range(100):
            writer.write("lidar/scan", scan(i), i * 10**8)
    with McapFile(whole) as file:
        block = file._blocks[-2]
    part = tmp_path / "part.mcap"
    part.write_bytes(whole.read_bytes()[: block.offset + block.length - 10])
    with RecordingReader(part) as reader:
        assert "2.00 s" in reader.problems[0]


def test_only_the_damaged_chunk_is_skipped(tmp_path):
    path = tmp_path / "rec.mcap"
    with RecordingWriter(path, chunk_s=1.0, compression=CompressionType.NONE) as writer:
        for i in range(100):
            writer.write("tick", tick(i), i * 10**8)
    with McapFile(path) as file:
        block = file._blocks[2]
    data = bytearray(path.read_bytes())
    data[block.offset + block.length // 2] ^= 0xFF
    path.write_bytes(data)
    with RecordingReader(path) as reader:
        assert len(list(reader.messages())) == 100 - 11
        assert "1 damaged chunk was left out: 1.0 s of 9.9 s are lost" in reader.problems[0]


def test_random_damage_raises_user_errors_only(tmp_path):
    rng = np.random.default_rng(5)
    file = tmp_path / "rec.mcap"
    with RecordingWriter(file, chunk_bytes=300) as writer:
        for i in range(20):
            writer.write("tick", tick(i), i)
    good = file.read_bytes()
    for _ in range(300):
        data = bytearray(good)
        for position in rng.integers(0, len(data), rng.integers(1, 20)):
            data[position] = rng.integers(0, 256)
        file.write_bytes(data)
        try:
            with RecordingReader(file) as reader:
                assert len(list(reader.messages())) <= 20
        except UserError as error:
            assert "rec.mcap" in str(error)  # noqa: PT017


def test_undecodable_messages_are_counted(tmp_path):
    path = tmp_path / "rec.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "beamsplat 1")
        meta = {"beamsplat.role": "own", "beamsplat.topic": "tick", "beamsplat.schema": "Tick/1.0"}
        channel = writer.register_channel("/beamsplat/tick", "x-beamsplat", 0, meta)
        future = writer.register_channel("/x", "x-beamsplat", 0, meta | {"beamsplat.schema": "Tick/99.0"})
        writer.add_message(channel, 1, b"invalid", 1)
        writer.add_message(future, 2, b"", 2)
        writer.finish()
    with RecordingReader(path) as reader:
        assert list(reader.messages()) == []
        assert reader.undecodable == {"tick": 2}
        assert "do not decode" in reader.problems[0]


def test_other_files_raise_user_error(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mcap").write_text("hello")
    foreign = tmp_path / "foreign.mcap"
    with foreign.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "somebody")
        writer.finish()
    for name, what in [
        ("empty", "no MCAP"),
        ("text.mcap", "not an MCAP"),
        ("foreign.mcap", "not a BeamSplat recording"),
    ]:
        assert not is_recording(tmp_path / name)
        with pytest.raises(UserError, match=what):
            RecordingReader(tmp_path / name)


def test_existing_recording_is_not_overwritten(tmp_path):
    (tmp_path / "rec").mkdir()
    with pytest.raises(UserError, match="exists already"):
        RecordingWriter(tmp_path / "rec")


def test_full_disk_raises_and_written_messages_stay_readable(tmp_path, monkeypatch):
    real_write = os.write
    room = 30_000

    def write(fd, data):
        nonlocal room
        if len(data) > room:
            real_write(fd, data[:room])  # a full disk writes a part
            room = 0
            raise OSError(errno.ENOSPC, "No space left on device")
        room -= len(data)
        return real_write(fd, data)

    monkeypatch.setattr(os, "write", write)
    writer = RecordingWriter(tmp_path / "rec", chunk_bytes=5000, compression=CompressionType.NONE)
    written = 0
    with pytest.raises(RecordingError, match="the disk is full"):  # noqa: PT012
        for i in range(1000):
            writer.write("lidar/scan", scan(i, beams=100), i)
            written += 1
    with pytest.raises(RecordingError, match="the disk is full"):
        writer.write("lidar/scan", scan(0), 0)
    writer.close()
    assert writer.counts.total() + writer.lost.total() == written + 2
    with RecordingReader(tmp_path / "rec") as reader:
        assert [r.message.stamp_ns for r in reader.messages()] == list(range(writer.counts.total()))
    assert writer.counts.total() > 10


CRASHING = """
import sys, time
from pathlib import Path
from beamsplat.common.messages import Tick
from beamsplat.common.recording import RecordingWriter
writer = RecordingWriter(Path(sys.argv[1]), chunk_s=1.0)
for i in range(95):
    writer.write("tick", Tick(stamp_ns=i, count=i), i * 10**8)
print("written", flush=True)
time.sleep(60)
"""


def test_killed_recorder_loses_its_open_chunk_only(tmp_path):
    child = subprocess.Popen(
        [sys.executable, "-c", CRASHING, str(tmp_path / "rec")],
        stdout=subprocess.PIPE, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert child.stdout.readline() == b"written\n"
    child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    with RecordingReader(tmp_path / "rec") as reader:
        # A chunk ends with the message that makes it one second long: 11 ticks each.
        assert [r.message.count for r in reader.messages()] == list(range(88))
        assert len(reader.problems) == 1


def test_values_finer_than_float32_and_beyond_2038_round_trip(tmp_path):
    late = Odometry(
        stamp_ns=2**62 - 1, T_odom_body=np.eye(4), covariance=np.full((3, 3), np.nan), status="lost"
    )
    wide = scan(3).model_copy(update={"range_max_m": 99999.123456789, "angle_min_rad": 0.1})
    picture = Image(
        stamp_ns=9, width_px=7, height_px=3, encoding="jpeg", data=np.frombuffer(b"no jpeg", np.uint8)
    )
    with RecordingWriter(tmp_path / "rec.mcap") as writer:
        for message in (late, wide, picture):
            writer.write(topic_of(message), message, 5)
    with RecordingReader(tmp_path / "rec.mcap") as reader:
        for back, message in zip(reader.messages(), (late, wide, picture)):
            assert_same(back.message, message)


@pytest.mark.parametrize(("extension", "encoding"), [(".jpg", "jpeg"), (".png", "png")])
def test_image_header_of_complete_and_truncated_images(extension, encoding):
    import cv2

    data = cv2.imencode(extension, np.zeros((37, 53, 3), np.uint8))[1].tobytes()
    assert read_image_header(data) == (encoding, 53, 37)
    for cut in range(0, 30):
        assert read_image_header(data[:cut]) in (None, (encoding, 53, 37))


def test_random_bytes_have_no_image_header():
    rng = np.random.default_rng(2)
    for _ in range(500):
        assert read_image_header(rng.bytes(rng.integers(0, 40))) is None
        read_image_header(b"\xff\xd8" + rng.bytes(rng.integers(0, 60)))
