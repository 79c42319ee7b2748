"""Save and resume of a mapper: identical map and optimisation, also after kills, full disks and broken files."""

import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.session import EDGE_MANIFEST, MANIFEST, SessionFolder
from beamsplat.common.mapfiles.state import keyframe_views, progress_of
from beamsplat.common.messages import Tick
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.services.keyframes.node import KeyframesConfig, KeyframesNode
from beamsplat.services.mapping.config import MappingConfig
from beamsplat.services.mapping.keyframe import StoredKeyframe
from beamsplat.services.mapping.mapper import FULL, HALF, Mapper
from beamsplat.services.mapping.messages import decode_keyframe
from beamsplat.services.mapping.node import MappingNode
from beamsplat.services.mapping.session.checkpointer import Checkpointer
from beamsplat.services.mapping.session.state import arrays_of, extras_of, restore
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import SECOND, feed, handle, insert_waiting, make_node, message

GOLDEN = Path(__file__).parent / "golden"


def picture(mapper, number=2):
    T_map_camera = r.T_map_body(number) @ r.T_BODY_CAMERA
    return np.clip(mapper.render(r.CAMERA, T_map_camera)[:3], 0.0, 1.0)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """(folder, the node that saved itself there at its end)."""
    folder = tmp_path_factory.mktemp("sessions") / "room"
    node = make_node(folder, session_every_s=1e6)
    feed(node, range(6))
    list(node.drain())
    node.close()
    return folder, node


@pytest.fixture
def copy(saved, tmp_path):
    shutil.copytree(saved[0], tmp_path / "copy")
    return tmp_path / "copy"


def test_a_loaded_map_renders_the_same_image(saved, copy):
    node = make_node(copy)
    before, after = picture(saved[1]._mapper), picture(node._mapper)
    mse = float(np.mean((before - after) ** 2))
    assert -10.0 * np.log10(max(mse, 1e-12)) >= 60.0
    np.testing.assert_array_equal(before, after)
    node.close()


def test_optimisation_continues_identically(saved, copy):
    """Every loss of the next steps is the same number; so are the keyframes drawn, the poses and exposures."""
    loaded = make_node(copy)
    ours = Mapper(saved[1]._mapper.settings)  # a second mapper from memory: the saved node stays as it is
    bodies = SessionFolder(copy)
    arrays = arrays_of(saved[1]._mapper)
    assert (
        restore(
            ours,
            arrays,
            lambda id: partial(decode_keyframe, message((id - r.T0) // SECOND), loaded._intake.undistorter),
        )
        == []
    )
    losses = [[m.step(m._draw(), HALF), m.refine(3), m.step(m._draw(), FULL)] for m in (ours, loaded._mapper)]
    assert losses[0] == losses[1]
    a, b = arrays_of(ours), arrays_of(loaded._mapper)
    for name in a:
        if name != "store_events":
            np.testing.assert_array_equal(a[name], b[name], name)
    assert len(bodies.keyframe_ids()) == 6
    loaded.close()


def test_a_resumed_run_equals_an_uninterrupted_one(saved, tmp_path):
    """Six keyframes, a stop, three more: the map of nine in a row, to the bit."""
    shutil.copytree(saved[0], tmp_path / "stopped")
    stopped = make_node(tmp_path / "stopped")
    sent = feed(stopped, range(6, 9))
    whole = make_node()
    feed(whole, range(9))
    a, b = stopped._mapper, whole._mapper
    assert list(a.keyframes) == list(b.keyframes)
    assert a.steps == b.steps
    np.testing.assert_array_equal(a.store.params[:, : a.store.count], b.store.params[:, : b.store.count])
    assert all("saved at" in status.session for status in sent["mapping/status"])
    revisions = a.store.versions()
    assert all(revisions[anchor] > version for anchor, version in b.store.versions().items())
    stopped.close()


def test_a_known_keyframe_is_acknowledged_and_not_taken_again(copy):
    node = make_node(copy)
    steps = node._mapper.steps
    sent = feed(node, [3])
    assert set(sent) == {"keyframes/ack"}
    assert node._mapper.steps == steps
    node.close()


def test_keyframes_newer_than_the_checkpoint_are_read_from_their_files(copy):
    node = make_node(copy, session_every_s=1e6)
    feed(node, range(6, 9))
    node.close()  # no drain: as if killed
    again = make_node(copy)
    assert len(again._mapper.keyframes) == 6  # the newer ones keep nobody waiting
    insert_waiting(again)
    assert len(again._mapper.keyframes) == 9
    np.testing.assert_array_equal(picture(node._mapper), picture(again._mapper))
    again.close()


def test_checkpoint_periods_count_measurement_time(tmp_path):
    """Every three seconds of stamps, ticks count too; two runs save at the same moments."""
    summaries = []
    for name in "ab":
        node, sent, seen = make_node(tmp_path / name, session_every_s=3.0), {}, []
        for number in range(8):
            handle(node, "keyframes/frame", message(number), sent)
            seen.append((SessionFolder(tmp_path / name).manifest() or {}).get("stamp_ns"))
        handle(node, "tick", Tick(stamp_ns=r.T0 + 9 * SECOND, count=1), sent)
        seen.append(SessionFolder(tmp_path / name).manifest()["stamp_ns"])
        summaries.append([None if s is None else (s - r.T0) // SECOND for s in seen])
        node.close()
    assert summaries[0] == summaries[1] == [None, None, None, 3, 3, 3, 6, 6, 9]
    assert len(list((tmp_path / "a" / "edge").glob("state-*.npz"))) == 1


def test_after_a_crash_the_next_checkpoint_is_not_later_than_without_it(tmp_path):
    node = make_node(tmp_path / "s", session_every_s=3.0)
    feed(node, range(5))  # saved at second 3
    node.close()  # no drain: as if killed
    again, stamps = make_node(tmp_path / "s", session_every_s=3.0), []
    for number in (5, 6, 7):
        feed(again, [number])
        stamps.append((SessionFolder(tmp_path / "s").manifest()["stamp_ns"] - r.T0) // SECOND)
    assert stamps == [3, 6, 6]
    again.close()


def test_lockstep_gives_the_same_map_with_a_session_as_without(tmp_path):
    def run(session):
        options = {"half_steps": 4, "full_steps": 3, "tick_steps": 2, "session_every_s": 1.0}
        node = MappingNode(MappingConfig(session=session, **options))
        source = r.RoomDrive(r.DriveConfig(pictures=12))
        Lockstep([source, r.Localizer(r.LocalizerConfig()), r.Fusion(r.Fusion.Config()),
                  KeyframesNode(KeyframesConfig(distance_m=0.15)), node]).run()  # fmt: skip
        return node._mapper.store

    with_session, without = run(tmp_path / "s"), run(None)
    assert with_session.count == without.count
    np.testing.assert_array_equal(with_session.params[:, : without.count], without.params[:, : without.count])
    arrays = SessionFolder(tmp_path / "s").read_state()
    np.testing.assert_array_equal(arrays["store_params"], without.params[:, : without.count])
    assert {"taken_id", "taken_stamp_ns"} <= set(extras_of(arrays))
    assert [view.id for view in keyframe_views(arrays)] == sorted(arrays["keyframe_id"].tolist())


def test_dropped_keyframes_are_removed_from_disk_after_the_next_checkpoint(tmp_path):
    node = make_node(tmp_path / "s", max_keyframes=4, session_every_s=1.0)
    feed(node, range(9))
    list(node.drain())
    folder = SessionFolder(tmp_path / "s")
    assert set(folder.keyframe_ids()) == set(node._mapper.keyframes)
    assert len(progress_of(folder.read_state())["forgotten"]) == 5
    node.close()


# --- faults ---


def work(folder, acknowledged):
    """A mapper that goes on from what it finds, until it is killed; tells which keyframes it acknowledged."""
    node = make_node(folder, session_every_s=2.0, half_steps=1, full_steps=1)
    for number in range(40):
        for output in node.handle("keyframes/frame", message(number % 12, r.T0 + number * SECOND)):
            if isinstance(output, tuple) and output[0] == "keyframes/ack":
                acknowledged.send(output[1].id)
            elif not isinstance(output, tuple):
                list(node.handle_job(output.name, output.run()))


@pytest.mark.slow
def test_twenty_kills_lose_no_acknowledged_keyframe_and_break_no_file(tmp_path):
    """kill -9 at random moments, often in the middle of a checkpoint, each time on what the last one left."""
    for number in range(12):
        message(number)  # rendered before the forks
    make_node(None)
    chance, known, moments = random.Random(3), set(), []
    fork = multiprocessing.get_context("fork")
    for _ in range(20):
        if len(known) >= 36:
            shutil.rmtree(tmp_path / "s")
            known = set()
        reader, writer = fork.Pipe(duplex=False)
        process = fork.Process(target=work, args=(tmp_path / "s", writer))
        process.start()
        writer.close()
        time.sleep(0.3 + chance.random() * 1.5)
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        try:
            while True:
                known.add(reader.recv())
        except EOFError:
            pass
        reader.close()
        folder = SessionFolder(tmp_path / "s")
        if not folder.exists():
            assert not known
            continue
        manifest = folder.manifest()
        arrays = folder.read_state()
        assert known <= set(folder.keyframe_ids())
        for id in known:
            folder.read_keyframe(id)
        if manifest is not None:
            # Every 2 s; one that is killed while it is written is tried again a keyframe later.
            assert manifest["stamp_ns"] >= max(known) - 6 * SECOND
            assert len(arrays["keyframe_id"]) == manifest["keyframes"]
        moments.append(len(known))
    assert max(moments) > 5
    node = make_node(tmp_path / "s", half_steps=1, full_steps=1)
    assert set(node._mapper.keyframes) >= known
    node.close()


def test_a_full_disk_leaves_the_checkpoint_valid_and_is_reported(tmp_path):
    """No file may grow any more: the map grows on, nothing is acknowledged; with room again all is caught up."""
    node = make_node(tmp_path / "s", session_every_s=2.0)
    feed(node, range(4))
    folder = SessionFolder(tmp_path / "s")
    before = folder.manifest()
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limit[1]))
    try:
        sent = feed(node, range(4, 8))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert "keyframes/ack" not in sent
    assert all(m.session.startswith("NOT SAVED: ") for m in sent["mapping/status"])
    assert "NOT SAVED" in node.detail
    assert len(node._mapper.keyframes) == 8
    assert folder.manifest() == before
    assert folder.read_state()["store_params"].shape[1] == before["gaussians"]
    assert not [p for p in (tmp_path / "s").rglob(".*") if p.is_file()]
    again = feed(node, range(4, 8))
    assert [ack.status for ack in again["keyframes/ack"]] == ["ok"] * 4
    status = feed(node, range(8, 10))["mapping/status"][-1]
    assert status.session.startswith("saved at ")
    assert folder.keyframe_ids() == sorted(node._mapper.keyframes)
    node.close()


def test_two_mappers_cannot_write_to_one_session(copy):
    node = make_node(copy)
    with pytest.raises(
        UserError, match=rf"another process uses this session \(process {os.getpid()} on .+\)"
    ):
        Checkpointer(copy, SECOND)
    node.close()
    Checkpointer(copy, SECOND).close()


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        (MANIFEST, {"version": 9}, "version 9, this program reads 1 to 1"),
        (MANIFEST, {"format": "zip"}, "field 'format'"),
        (MANIFEST, {"uuid": None}, "field 'uuid' is missing"),
        (f"edge/{EDGE_MANIFEST}", {"version": 0}, "version 0"),
        (f"edge/{EDGE_MANIFEST}", {"state": None}, "field 'state' is missing"),
        (f"edge/{EDGE_MANIFEST}", {"bytes": 7}, "truncated"),
    ],
)
def test_a_manifest_that_does_not_fit_says_why(copy, file, change, words):
    table = json.loads((copy / file).read_text())
    (copy / file).write_text(json.dumps(table | change))
    with pytest.raises(UserError, match=words):
        make_node(copy)


def test_a_broken_state_is_named_and_not_overwritten(copy):
    state = next((copy / "edge").glob("state-*.npz"))
    blob = bytearray(state.read_bytes())
    blob[len(blob) // 2] ^= 0xFF
    state.write_bytes(bytes(blob))
    with pytest.raises(UserError, match=state.name):
        make_node(copy)
    assert state.read_bytes() == bytes(blob)


def test_a_broken_keyframe_loses_only_itself(saved, copy, caplog):
    body = sorted((copy / "edge" / "keyframes").glob("*.kf"))[1]
    body.write_bytes(body.read_bytes()[:-9])
    node = make_node(copy)
    assert len(node._mapper.keyframes) == 5
    assert "truncated or altered" in caplog.text
    np.testing.assert_array_equal(picture(saved[1]._mapper), picture(node._mapper))
    assert isinstance(next(iter(node._mapper.keyframes.values())), StoredKeyframe)
    node.close()


def test_a_folder_that_is_no_session_is_refused(tmp_path):
    with pytest.raises(UserError, match="a folder written by"):
        SessionFolder(tmp_path).header()


@pytest.mark.parametrize("version", [1, 2])
def test_sessions_of_released_versions_open(version, tmp_path):
    """A session that the program of that version wrote (tests.services.mapping.session.write_golden)."""
    shutil.copytree(GOLDEN / f"session-{version}", tmp_path / "old")
    node = make_node(tmp_path / "old")
    expected = json.loads((GOLDEN / f"session-{version}.json").read_text())
    assert len(node._mapper.keyframes) == expected["keyframes"]
    assert node._mapper.store.count == expected["gaussians"]
    params = node._mapper.store.params[:, : node._mapper.store.count]
    nearest = np.abs(params - np.array(expected["first_gaussian"])[:, None]).max(axis=0).argmin()
    assert nearest == 0 or version > 1
    np.testing.assert_allclose(params[:, nearest], expected["first_gaussian"], rtol=1e-6)
    feed(node, [7])
    assert len(node._mapper.keyframes) == expected["keyframes"] + 1
    node.close()
