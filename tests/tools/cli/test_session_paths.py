"""Which paths the commands about maps and trajectories take, and what they say of others."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.trajectory import Trajectory, write_tum
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.services.localization.lidar2d.merge import MapAlignment
from beamsplat.tools.cli import session as session_cli
from beamsplat.tools.cli.main import app
from beamsplat.tools.cli.options import session_folder
from beamsplat.tools.sessions.merge import merge_doubt


def test_a_session_is_found_in_the_folder_of_a_demo(tmp_path):
    SessionFolder(tmp_path / "out" / "session").create()
    assert session_folder(tmp_path / "out") == tmp_path / "out" / "session"
    assert session_folder(tmp_path / "out" / "session") == tmp_path / "out" / "session"
    assert session_folder(tmp_path / "absent") == tmp_path / "absent"
    done = CliRunner().invoke(app, ["session", "info", str(tmp_path / "out"), "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["uuid"] == SessionFolder(tmp_path / "out" / "session").header()["uuid"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("export", "{}", "--to", "ply"),
        ("render", "{}", "--path", "orbit", "--out", "x.mp4"),
        ("session", "info", "{}"),
        ("session", "prune", "{}"),
        ("session", "join", "{}", "robot"),
        ("session", "merge", "{}", "b", "--out", "c"),
    ],
)
def test_a_file_in_the_place_of_a_session_is_told_what_is_taken(tmp_path, arguments):
    file = tmp_path / "splats.ply"
    file.write_text("ply\n")
    with pytest.raises(UserError, match=r"splats.ply is a file: give the folder of a session"):
        CliRunner().invoke(app, [a.replace("{}", str(file)) for a in arguments], catch_exceptions=False)


@pytest.fixture
def trajectories(tmp_path):
    """A folder with trajectory.tum and the truth beside it, 0.1 m apart from the second pose on."""
    stamps_ns = np.arange(5, dtype=np.int64) * 10**9 + 10**9
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, 0, 3] = np.arange(5)
    write_tum(tmp_path / "truth.tum", Trajectory(stamps_ns, T), "truth")
    T[1:, 1, 3] += 0.1
    (tmp_path / "map").mkdir()
    write_tum(tmp_path / "map" / "trajectory.tum", Trajectory(stamps_ns, T), "found")
    return tmp_path


@pytest.mark.parametrize("name", ["map", "map/trajectory.tum"])
def test_eval_slam_takes_the_folder_or_the_trajectory_itself(trajectories, name):
    words = [
        "eval",
        "slam",
        str(trajectories / name),
        "--groundtruth",
        str(trajectories / "truth.tum"),
        "--json",
    ]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert json.loads(done.stdout)["poses"] == 5
    assert json.loads(done.stdout)["ate_first_pose_rmse_m"] == pytest.approx(np.sqrt(4 * 0.01 / 5), rel=1e-3)


def test_eval_slam_says_why_relations_need_the_folder(trajectories):
    words = ["eval", "slam", str(trajectories / "map" / "trajectory.tum"), "--relations", "x"]
    with pytest.raises(UserError, match=r"no figures.json"):
        CliRunner().invoke(app, words, catch_exceptions=False)


def test_a_place_that_nothing_confirms_is_doubted():
    assert "only 10 of 24 scans agree" in merge_doubt(10, 24, 0)
    assert merge_doubt(10, 24, 1) == ""
    assert merge_doubt(13, 24, 0) == ""
    assert merge_doubt(12, 24, 0) != ""


@pytest.mark.parametrize(("loops", "code"), [(0, 3), (2, 0)])
def test_a_merge_that_cannot_be_trusted_ends_with_code_3_and_says_what_to_do(
    tmp_path, monkeypatch, loops, code
):
    arrays = {
        "anchor_id": np.array([0]), "keyframe_id": np.array([], np.int64), "store_params": np.zeros((14, 3)),
    }  # fmt: skip
    for name in "ab":
        folder = SessionFolder(tmp_path / name)
        folder.create()
        folder.robot.mkdir()
        (folder.robot / session_cli.ROBOT_MANIFEST).write_text("{}")
    slam = SimpleNamespace(
        pose_graph=SimpleNamespace(submaps=[0]), anchors=dict, save=lambda folder: folder.mkdir()
    )
    alignment = MapAlignment(np.zeros(3), 10, 24)
    monkeypatch.setattr(session_cli, "read_saved", lambda folder: arrays)
    monkeypatch.setattr(session_cli, "load_slam", lambda path: slam)
    monkeypatch.setattr(session_cli, "_aligned", lambda *_: alignment)
    monkeypatch.setattr(session_cli, "write_saved", lambda *_: None)
    edit, merge = "beamsplat.tools.sessions.edit", "beamsplat.tools.sessions.merge"
    monkeypatch.setattr(f"{edit}.merged", lambda *_: arrays)
    monkeypatch.setattr(f"{edit}.with_anchors", lambda *_: arrays)
    monkeypatch.setattr(f"{merge}.deduplicated", lambda *_: arrays)
    monkeypatch.setattr("beamsplat.services.localization.lidar2d.merge.merge_into", lambda *_: loops)
    words = ["session", "merge", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "c")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == code, done.output
    if code:
        assert "do not trust it" in done.output
        assert "--place X,Y,DEG" in done.output
