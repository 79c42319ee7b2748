"""What was not acknowledged: sent again in time, kept within bounds, on a disk that may fail."""

import errno
import os
import struct
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamsplat.common.errors import UserError
from beamsplat.services.keyframes.outbox import Outbox, most_redundant
from beamsplat.services.keyframes.queue_folder import CorruptFile, QueueEntry, QueueFolder, _read_head
from tests.common.files.faulty_disk import FaultyDisk

S = 1_000_000_000
SCHEMA = "Keyframe/2.0"


def view(x, heading=0.0):
    return np.array([x, 0.0, 0.0, np.cos(heading) / 0.22, np.sin(heading) / 0.22, 0.0])


def put(box, key, now_ns=0, x=None, payload=None):
    box.put(key, view(float(key) if x is None else x), SCHEMA, payload or f"frame {key}".encode(), now_ns)


def sent(box, now_ns):
    return [key for key, _, _ in box.due(now_ns)]


@pytest.fixture(params=["memory", "disk"])
def folder(request, tmp_path):
    return tmp_path / "queue" if request.param == "disk" else None


def test_while_nobody_answers_only_the_oldest_is_tried(folder):
    box = Outbox(10_000, 5 * S, 4, folder)
    for i in range(3):
        put(box, i, i * S)
    assert sent(box, 4 * S) == []
    assert list(box.due(5 * S)) == [(0, SCHEMA, b"frame 0")]
    assert sent(box, 6 * S) == []  # frame 1 is old too, but nobody has answered
    assert sent(box, 10 * S) == [0]


def test_an_answer_brings_the_rest_a_few_at_a_time_oldest_first_and_now_and_then_the_newest(folder):
    box = Outbox(10_000, 5 * S, 2, folder)
    for i in range(7):
        put(box, i)
    assert sent(box, 5 * S) == [0]
    assert box.acknowledge(0, 5 * S)
    assert sent(box, 5 * S) == [1, 2]
    assert sent(box, 5 * S) == []  # two are on their way
    assert box.acknowledge(1, 6 * S)
    assert sent(box, 6 * S) == [3]
    assert box.acknowledge(2, 6 * S)
    assert sent(box, 6 * S) == [6]  # every fourth
    for key in (3, 4, 5, 6):
        assert box.acknowledge(key, 6 * S)
        list(box.due(6 * S))
    assert sent(box, 99 * S) == []
    assert not box.acknowledge(2, 99 * S)
    assert len(box) == box.bytes == 0


def test_what_is_on_its_way_to_a_slow_mapper_is_not_sent_twice():
    """Answers in the order of sending tell that nothing was lost, however late they come."""
    box = Outbox(10_000, 5 * S, 4)
    for i in range(20):
        put(box, i, i * S)
    for i in range(20):
        assert box.acknowledge(i, (20 + 3 * i) * S)
        assert sent(box, (20 + 3 * i) * S + 1) == []


def test_a_live_one_goes_out_at_once_and_shows_what_was_lost_before():
    box = Outbox(10_000, 60 * S, 4)
    put(box, 1, 0)
    put(box, 2, S)  # both lost
    put(box, 3, 2 * S)  # the link is back
    assert sent(box, 2 * S) == []
    box.acknowledge(3, 3 * S)
    assert sent(box, 3 * S) == [1, 2]


def test_beyond_the_bound_the_least_useful_goes_and_is_counted(folder):
    box = Outbox(45, S, 4, folder)  # six of 7 bytes
    for key, x in enumerate([0.0, 1.0, 2.0, 2.1, 3.0, 4.0]):
        put(box, key, x=x)
    assert box.dropped == 0
    put(box, 6, x=5.0)
    assert (box.dropped, len(box)) == (1, 6)
    left = [key for key in range(7) if box.acknowledge(key, 0)]
    assert left == [0, 1, 2, 4, 5, 6]  # 2 and 3 are alike; the next neighbour of 3 is nearer (0.9 m, not 1 m)


def test_the_newest_is_never_thrown_away():
    box = Outbox(10, S, 4)
    for key in range(5):
        put(box, key, x=0.0)  # the robot stands still
    assert (len(box), box.dropped) == (1, 4)
    assert box.acknowledge(4, 0)


def test_the_queue_survives_a_restart(tmp_path):
    box = Outbox(10_000, 5 * S, 4, tmp_path)
    box.drive = "a"
    for key in range(3):
        put(box, key)
    box.acknowledge(1, 0)
    again = Outbox(10_000, 5 * S, 4, tmp_path)
    assert (len(again), again.of_earlier_drives, again.bytes) == (0, 2, 14)
    assert sent(again, 0) == []  # whose anchors they hang on is not known yet
    again.drive = "a"
    assert (len(again), again.of_earlier_drives) == (2, 0)
    assert sent(again, 7 * S) == [0]  # is there anybody?
    again.acknowledge(0, 8 * S)
    assert list(again.due(8 * S)) == [(2, SCHEMA, b"frame 2")]


def test_keyframes_of_an_earlier_drive_stay_but_make_room_first(tmp_path):
    box = Outbox(50, S, 4, tmp_path)
    box.drive = "monday"
    for key in range(3):
        put(box, key)
    box = Outbox(50, S, 4, tmp_path)
    box.drive = "tuesday"
    for key in range(10, 15):
        put(box, key, x=0.0)
    assert (len(box), box.of_earlier_drives, box.dropped) == (5, 1, 2)
    assert sent(box, 9 * S) == [10]  # not what hangs on another map


def test_a_drive_may_get_the_name_of_its_map_when_that_is_known():
    box = Outbox(10_000, S, 4)
    box.drive = "process 1"
    put(box, 0)
    box.rename_drive("process 1", "map")
    put(box, 1)
    box.drive = "process 2"
    assert (len(box), box.of_earlier_drives) == (0, 2)
    box.rename_drive("process 2", "map")  # localization was started again, in the same map
    assert (len(box), box.of_earlier_drives) == (2, 0)


def test_broken_files_are_counted_and_the_rest_goes_on(tmp_path, caplog):
    box = Outbox(10_000, S, 4, tmp_path)
    for key in range(5):
        put(box, key, payload=bytes([key]) * 100)
    files = sorted(tmp_path.iterdir())
    files[0].write_bytes(b"rubbish")
    files[1].write_bytes(files[1].read_bytes()[:-1])  # cut off
    data = bytearray(files[2].read_bytes())
    data[-1] ^= 1  # one bit
    files[2].write_bytes(data)
    (tmp_path / ".00000000000000000009.keyframe.77").write_bytes(b"half")  # left by a crash
    again = Outbox(10_000, S, 4, tmp_path)
    assert (len(again), again.corrupt) == (3, 2)
    assert sent(again, 9 * S) == []  # frame 2 is tried, and is corrupt
    assert (len(again), again.corrupt) == (2, 3)
    assert list(again.due(99 * S)) == [(3, SCHEMA, b"\x03" * 100)]
    assert sorted(tmp_path.iterdir()) == files[3:]
    assert "checksum" in caplog.text


def test_a_file_that_vanishes_is_counted(tmp_path):
    box = Outbox(10_000, S, 4, tmp_path)
    put(box, 1)
    next(tmp_path.iterdir()).unlink()
    assert sent(box, 9 * S) == []
    assert (len(box), box.corrupt) == (0, 1)


def test_a_full_disk_is_said_and_counted_and_keyframes_go_on_in_memory(tmp_path, monkeypatch, caplog):
    """The kernel's own word for it: the file system's limit on the size of a file."""
    resource = pytest.importorskip("resource")
    import signal

    box = Outbox(10_000_000, S, 4, tmp_path)
    put(box, 1)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
        put(box, 2, payload=b"x" * 5000)
        put(box, 3, payload=b"y" * 5000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert (len(box), box.not_on_disk, box.disk_fault) == (3, 2, "File too large")
    assert caplog.text.count("keyframes cannot be written") == 1  # said at a bounded rate
    put(box, 4)  # there is room again
    box.acknowledge(4, 0)
    assert list(box.due(0)) == [
        (1, SCHEMA, b"frame 1"), (2, SCHEMA, b"x" * 5000), (3, SCHEMA, b"y" * 5000)
    ]  # fmt: skip
    assert (box.not_on_disk, box.disk_fault) == (0, "")
    assert len(Outbox(10_000_000, S, 4, tmp_path)._entries) == 3  # those from memory are on the disk now


def test_a_file_that_the_disk_cannot_read_stays_for_the_next_start(tmp_path):
    for key in (1, 2):
        put(Outbox(10_000_000, S, 4, tmp_path), key)
    first = sorted(tmp_path.iterdir())[0]
    with FaultyDisk(0, "from then on"):
        box = Outbox(10_000_000, S, 4, tmp_path)
    assert len(box._entries) == 0
    assert box.corrupt
    box = Outbox(10_000_000, S, 4, tmp_path)
    with FaultyDisk(0, "from then on"):
        assert sent(box, 9 * S) == []
    assert box.corrupt == 1
    assert first.exists()


def test_a_file_that_a_read_only_disk_kept_is_removed_once_the_disk_accepts_a_keyframe(tmp_path, monkeypatch):
    box = Outbox(10**6, 10**10, 4, tmp_path)
    put(box, 1)
    put(box, 2)

    def refuse(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    with monkeypatch.context() as read_only:
        read_only.setattr(Path, "unlink", refuse)
        assert box.acknowledge(1, 0)
    assert len(list(tmp_path.iterdir())) == 2
    put(box, 3)
    assert {int(file.stem) for file in tmp_path.iterdir()} == {2, 3}


def test_bounds_and_folders_that_make_no_sense_are_refused(tmp_path):
    for bounds in ((0, S, 1), (1, 0, 1), (1, S, 0)):
        with pytest.raises(ValueError, match="positive"):
            Outbox(*bounds)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="choose another"):
        Outbox(1, S, 1, tmp_path / "file")


@given(st.binary(max_size=200))
def test_any_bytes_are_a_label_or_broken(data):
    for candidate in (data, b"BSK1" + data, b"BSK1" + len(data).to_bytes(4, "little") + data):
        try:
            label, start = _read_head(candidate)
        except CorruptFile:
            continue
        assert isinstance(label, QueueEntry)
        assert 8 <= start <= len(candidate)


def test_a_file_of_an_earlier_program_is_of_the_version_of_that_time(tmp_path):
    folder = QueueFolder(tmp_path)
    folder.write(QueueEntry(7, "d", (0.0,) * 6, 4, SCHEMA), b"data")
    (file,) = tmp_path.iterdir()
    (length,) = struct.unpack_from("<I", file.read_bytes(), 4)
    head = msgpack.unpackb(file.read_bytes()[8 : 8 + length])
    assert head.pop("schema") == SCHEMA
    old_head = msgpack.packb(head)
    file.write_bytes(b"BSK1" + struct.pack("<I", len(old_head)) + old_head + b"data")
    box = Outbox(10_000, S, 4, tmp_path)
    box.drive = "d"
    assert list(box.due(9 * S)) == [(7, "Keyframe/1.2", b"data")]


def test_folder_names_sort_as_time_does(tmp_path):
    folder = QueueFolder(tmp_path)
    keys = [10**18, 5, 10**18 + 1, 99]
    for key in keys:
        folder.write(QueueEntry(key, "", (0.0,) * 6, 1), b"x")
    assert [label.key for label in folder.entries()] == sorted(keys)
    if os.getuid() != 0:
        tmp_path.chmod(0o500)
        folder.remove(5)  # says so, and goes on


@pytest.mark.parametrize("seed", range(5))
def test_the_least_useful_view_is_one_of_the_nearest_pair(seed):
    rng = np.random.default_rng(seed)
    views = rng.normal(size=(30, 6))
    apart = np.linalg.norm(views[:, None] - views[None], axis=2) + np.eye(30) * 1e9
    pair = set(np.unravel_index(np.argmin(apart), apart.shape))
    chosen = most_redundant(views, None)
    assert chosen in pair
    (other,) = pair - {chosen}
    assert np.sort(apart[chosen])[1] <= np.sort(apart[other])[1]
    assert most_redundant(views, chosen) == other
    assert most_redundant(views[:2], 0) == 1
    assert most_redundant(views[:1], None) == 0
    with pytest.raises(ValueError, match="no view"):
        most_redundant(views[:1], 0)
