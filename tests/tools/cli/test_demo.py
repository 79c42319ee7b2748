"""The demo as a user runs it: its files open, its figures are about the drive."""

import json
import shutil

import cv2
import numpy as np
import pytest
from plyfile import PlyData
from typer.testing import CliRunner

from beamsplat.common.geometry.trajectory import read_tum
from beamsplat.tools.cli.demo import demo
from beamsplat.tools.cli.main import app


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    from beamsplat.tools.cli.simulate import simulate

    folder = tmp_path_factory.mktemp("demo") / "drive"
    simulate(folder, seconds=8.0)
    return folder


def run(source, out, free_endpoint):
    demo(
        out=out, data=source, seconds=8.0, rate=1.0, view="none", browser=False,
        set_=[f'router.listen=["{free_endpoint}"]', f'state_dir="{out / "state"}"', "monitor.grpc_port=0"],
    )  # fmt: skip
    return json.loads((out / "report.json").read_text())


@pytest.mark.slow
def test_the_demo_leaves_what_it_names(drive, tmp_path, free_endpoint, capsys):
    figures = run(drive / "bag", tmp_path / "out", free_endpoint)
    said = capsys.readouterr().out
    for name in (
        "splats.ply",
        "map.png",
        "trajectory.tum",
        "report.html",
        "session",
        "demo.rrd",
        "recording",
    ):
        assert name in said
    shown = CliRunner().invoke(app, ["session", "info", str(tmp_path / "out"), "--json"])
    assert json.loads(shown.stdout)["robot"]["submaps"] >= 1, "the session lacks the robot's half"
    exported = CliRunner().invoke(app, ["export", str(tmp_path / "out"), "--to", "nav2"])
    assert exported.exit_code == 0, exported.output
    assert figures["ate_first_pose_rmse_m"] < 0.05
    assert figures["keyframes"] >= 3
    assert PlyData.read(tmp_path / "out" / "map" / "splats.ply")["vertex"].count == figures["gaussians"]
    truth = read_tum(drive / "groundtruth.txt")
    found = read_tum(tmp_path / "out" / "trajectory.tum")
    lengths_m = [np.linalg.norm(np.diff(t.T_a_b[:, :3, 3], axis=0), axis=1).sum() for t in (truth, found)]
    assert lengths_m[1] == pytest.approx(lengths_m[0], rel=0.15)
    assert cv2.imread(str(tmp_path / "out" / "map.png")).std() > 10.0
    assert "src='data:image/jpeg" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.slow
def test_a_bag_without_truth_gets_a_report_without_errors(drive, tmp_path, free_endpoint):
    shutil.copytree(drive / "bag", tmp_path / "alone" / "bag")
    figures = run(tmp_path / "alone" / "bag", tmp_path / "out", free_endpoint)
    assert figures["images"] > 50
    assert figures["keyframes"] >= 3
    assert "ate_first_pose_rmse_m" not in figures  # against itself it would be zero
    assert "psnr_offpath_db" not in figures
