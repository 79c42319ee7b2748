"""The mapper's session and the lidar map read as the old or the new state, whatever fails while writing."""

import contextlib
import dataclasses
import functools
import shutil
from functools import partial

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.services.localization.lidar2d.map_records import SavedMap
from beamsplat.services.localization.lidar2d.map_saver import MapSaver
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.state import load_state
from beamsplat.services.localization.lidar2d.trajectory_record import TrajectoryRecord
from tests.common.files.faulty_disk import FaultyDisk, killed_at
from tests.services.localization.graphs import grow

SETTINGS = LidarSlamSettings()


class Session:
    """The state of a mapper: one array that contains a number."""

    left = 2  # files

    def __init__(self, path):
        self.folder, self.files = SessionFolder(path), path / "edge"
        self.folder.create()

    def write(self, value):
        self.folder.write_state({"value": np.full(2000, value)}, {"keyframes": value})

    def read(self):
        assert self.folder.manifest()["keyframes"] == self.folder.read_state()["value"][0]
        return int(self.folder.read_state()["value"][0])

    def moved_to(self, path):
        return Session(path)

    def clean(self):
        return {path.name for path in self.files.iterdir()} - {"gaussians", "keyframes", "lock"}


@functools.cache
def growth():
    """Return the saved parts of a map at four times, while it grows."""
    graph, out = PoseGraph(SETTINGS), []
    for value in range(4):
        grow(graph, 5)
        graph.uuid = str(value)
        out.append(SavedMap.of(graph, TrajectoryRecord()))
    return out


def long_record():
    """Return the record of 400 scans."""
    record = TrajectoryRecord()
    for number in range(400):
        record.add(number, 0, np.zeros(3), np.full(3, number))
    return record


class LidarMap:
    """The state of the lidar SLAM: a map that grows with its number, saved by one process."""

    left = 3  # files

    def __init__(self, path):
        self.files, self.record = path, long_record()
        self.saver = MapSaver(path, SETTINGS)

    def write(self, value):
        self.saver.save(dataclasses.replace(growth()[value], record=self.record, scans=100 * (value + 1)))

    def read(self):
        graph, rows = load_state(self.files, SETTINGS)
        value = int(graph.uuid)
        expected = growth()[value]
        assert [n.scan for n in graph.nodes.values()] == [n.scan for n in expected.nodes]
        assert list(graph.submaps) == [s.id for s in expected.submaps]
        assert rows["extra_poses"][:, 3].tolist() == list(range(100 * (value + 1)))
        assert [(c.submap, c.node) for c in graph.constraints] == [
            (c.submap, c.node) for c in expected.constraints
        ]
        return value

    def clean(self):
        return {path.name for path in self.files.iterdir()}

    def moved_to(self, path):
        """Return the writer as if it had written to another folder."""
        out = type(self)(path)
        out.record, out.saver._journal = self.record, self.saver._journal
        return out


@pytest.fixture(params=[Session, LidarMap])
def saved(request, tmp_path):
    """A function that returns the writer of a folder with state 1, which it has written after state 0."""

    source = request.param(tmp_path / "saved")
    source.write(0)
    source.write(1)

    def copy():
        shutil.rmtree(tmp_path / "copy", ignore_errors=True)
        shutil.copytree(tmp_path / "saved", tmp_path / "copy")
        return source.moved_to(tmp_path / "copy")

    return copy


def check(state, where):
    """The state is the old or the new one; the next write succeeds and leaves no other files."""
    assert state.read() in (1, 2), where
    state.write(3)
    assert state.read() == 3, where
    assert len(state.clean()) == state.left, f"{where}: {state.clean()}"


@pytest.mark.parametrize("how", ["once", "from then on"])
def test_an_error_of_any_call_leaves_the_old_or_the_new_state(saved, how):
    with FaultyDisk() as disk:
        saved().write(2)
    assert {"open", "write", "fsync", "replace", "unlink", "close"} <= set(disk.calls)
    for at, call in enumerate(disk.calls):
        state = saved()
        with FaultyDisk(at, how), contextlib.suppress(OSError):
            state.write(2)
        check(state, f"{call} (call {at})")


def test_an_error_in_a_restarted_process_leaves_the_old_or_the_new_map(tmp_path):
    """It writes a new journal, because it does not know what the old one contains."""
    source = LidarMap(tmp_path / "saved")
    source.write(1)

    def run(at):
        shutil.rmtree(tmp_path / "copy", ignore_errors=True)
        shutil.copytree(tmp_path / "saved", tmp_path / "copy")
        state = LidarMap(tmp_path / "copy")
        with FaultyDisk(at) as disk, contextlib.suppress(OSError):
            state.write(2)
        if at is not None:
            check(state, f"call {at}")
        return disk.calls

    for at in range(len(run(None))):
        run(at)


def test_a_kill_at_any_call_leaves_the_old_or_the_new_state(saved):
    at = 0
    while True:
        state = saved()
        if not killed_at(at, partial(state.write, 2)):
            break
        check(state, f"call {at}")
        at += 1
    assert at > 10


def test_an_error_while_the_first_state_is_written_leaves_none(tmp_path):
    def run(at):
        shutil.rmtree(tmp_path / "s", ignore_errors=True)
        session = Session(tmp_path / "s")
        with FaultyDisk(at) as disk, contextlib.suppress(OSError):
            session.write(2)
        assert session.folder.manifest() is None or session.read() == 2
        return disk.calls

    for at in range(len(run(None))):
        run(at)


def test_a_file_that_only_resembles_a_state_is_ignored(saved):
    state = saved()
    prefix = "state" if isinstance(state, Session) else "lidar_map"
    for name in (f"{prefix}-old.npz", f"{prefix}-.npz", f"{prefix}-007.npz"):
        (state.files / name).write_text("stray")
    (state.files / f"{prefix}-3.npz").mkdir()
    state.write(2)
    state.write(3)
    assert state.read() == 3
    assert (state.files / f"{prefix}-old.npz").read_text() == "stray"
    assert (state.files / f"{prefix}-3.npz").is_dir()


def test_a_manifest_with_values_of_a_wrong_kind_is_an_error_that_names_it(saved):
    state = saved()
    name = "edge.json" if isinstance(state, Session) else "lidar_map.json"
    field = "state" if isinstance(state, Session) else "arrays"
    for text in ("[]", "{", "\udcff", f'{{"version": 1, "format": "beamsplat-lidar-map", "{field}": 7}}'):
        (state.files / name).write_bytes(text.encode(errors="surrogateescape"))
        with pytest.raises(UserError, match=name):
            state.read()
