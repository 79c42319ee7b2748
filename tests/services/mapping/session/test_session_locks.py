"""Commands that change a session hold its lock from before they read it until they have written it."""

import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.tools.cli.main import app
from tests.services.localization.world import RayCastLidar, SimulatedDrive
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import SECOND, feed, handle, make_node, message

# A process that adds an array to the state of a session; it is refused while the session is locked.
WRITER = """
import sys
import numpy as np
from pathlib import Path
from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.session import SessionFolder
folder = SessionFolder(Path(sys.argv[1]))
try:
    folder.lock()
except UserError:
    sys.exit(7)
summary = {key: folder.manifest()[key] for key in ("keyframes", "gaussians", "steps", "anchors", "stamp_ns")}
folder.write_state(folder.read_state() | {"extra_of_the_writer": np.array([1])}, summary)
folder.unlock()
"""


def write_in_another_process(session):
    """Return whether another process could write to the session now."""
    code = subprocess.run([sys.executable, "-c", WRITER, session], check=False).returncode
    assert code in (0, 7)
    return code == 0


@pytest.fixture
def session(tmp_path):
    """The folder of a session with four keyframes."""
    node = make_node(tmp_path / "s", half_steps=1, full_steps=1)
    feed(node, range(4))
    list(node.drain())
    node.close()
    return tmp_path / "s"


@pytest.fixture
def robot(tmp_path):
    """The folder of a lidar map of the same time as the session."""
    slam, lidar, path = LidarSlam(LidarSlamSettings(), np.eye(4)), RayCastLidar(beams=90), SimulatedDrive()
    for number in range(30):
        slam.add_scan(r.T0 + number * SECOND // 10, lidar.scan(path, number * 0.1), *lidar.arguments())
    slam.finish()
    slam.save(tmp_path / "robot")
    return tmp_path / "robot"


def run(*words):
    result = CliRunner().invoke(app, ["session", *map(str, words)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.mark.parametrize("command", ["prune", "join"])
def test_what_another_process_writes_before_the_lock_is_not_overwritten(session, robot, command, monkeypatch):
    """The other process writes immediately before the lock is taken, and tries to while the command writes."""
    lock, write = SessionFolder.lock, SessionFolder.write_state
    wrote = []

    def lock_late(folder, *args, **kwargs):
        wrote.append(write_in_another_process(session))
        lock(folder, *args, **kwargs)

    def write_late(folder, *args):
        wrote.append(write_in_another_process(session))
        write(folder, *args)

    monkeypatch.setattr(SessionFolder, "lock", lock_late)
    monkeypatch.setattr(SessionFolder, "write_state", write_late)
    run(command, session, *([robot] if command == "join" else ["--keyframes", "3"]))
    assert wrote == [True, False]
    assert "extra_of_the_writer" in SessionFolder(session).read_state()
    assert write_in_another_process(session)  # the lock was released


def test_a_merge_locks_its_sources_and_its_target(session, tmp_path, monkeypatch):
    second = make_node(tmp_path / "t", half_steps=1, full_steps=1)
    for number in range(3):
        handle(second, "keyframes/frame", message(number, r.T0 + (3600 + number) * SECOND))
    list(second.drain())
    second.close()
    write = SessionFolder.write_keyframe
    wrote = set()

    def write_late(folder, *args):
        wrote.add((write_in_another_process(session), write_in_another_process(tmp_path / "t")))
        with pytest.raises(UserError, match="another process uses this session"):
            SessionFolder(tmp_path / "both").lock()
        SessionFolder(session).lock(shared=True)  # other readers are not refused
        monkeypatch.setattr(SessionFolder, "write_keyframe", write)
        write(folder, *args)

    monkeypatch.setattr(SessionFolder, "write_keyframe", write_late)
    assert (
        "7 keyframes"
        in run("merge", session, tmp_path / "t", "--out", tmp_path / "both", "--place", "0,0,0").stdout
    )
    assert wrote == {(False, False)}
    assert write_in_another_process(session)


def test_a_merge_into_a_session_that_another_process_has_just_created_is_refused(
    session, tmp_path, monkeypatch
):
    create = SessionFolder.create

    def create_late(folder):
        other = SessionFolder(folder.path)
        create(other)
        other.lock()
        other.write_state({"value": np.arange(3)}, {})
        other.unlock()
        create(folder)

    monkeypatch.setattr(SessionFolder, "create", create_late)
    with pytest.raises(UserError, match="contains a session already"):
        run("merge", session, session, "--out", tmp_path / "both", "--place", "0,0,0")
    assert SessionFolder(tmp_path / "both").read_state()["value"].tolist() == [0, 1, 2]


def test_a_merge_that_fails_leaves_no_session(session, tmp_path):
    with pytest.raises(UserError, match="share 4 keyframes"):
        run("merge", session, session, "--out", tmp_path / "both", "--place", "0,0,0")
    assert not (tmp_path / "both").exists()
