"""Exit code 3 of commands whose recording gives no pose or no depth, with the reasons."""

import json

import cv2
import numpy as np
import pytest

from beamsplat.tools.cli.main import main
from tests.common.geometry.test_rig import RIG

START_NS = 1_767_225_600 * 10**9


@pytest.fixture
def blind(tmp_path):
    """A folder whose lidar measures nothing and whose images are damaged."""
    folder = tmp_path / "drive"
    (folder / "images").mkdir(parents=True)
    (folder / "rig.toml").write_text(RIG)
    limits = (
        "# angle_min_rad = -3.1\n# angle_increment_rad = 0.1\n# range_min_m = 0.1\n# range_max_m = 12.0\n"
    )
    stamps_ns = [START_NS + i * 10**8 for i in range(20)]
    rows = [f"{stamp_ns}, {', '.join(['nan'] * 62)}" for stamp_ns in stamps_ns]
    (folder / "scans.csv").write_text(limits + "\n".join(rows) + "\n")
    poses = [f"{stamp_ns / 1e9:.1f} 0 0 0 0 0 0 1" for stamp_ns in stamps_ns]
    (folder / "poses.txt").write_text("\n".join(poses) + "\n")
    jpeg = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8))[
        1
    ].tobytes()
    for stamp_ns in stamps_ns[::5]:
        (folder / "images" / f"{stamp_ns}.jpg").write_bytes(jpeg[:2000])
    return folder


def run(monkeypatch, *arguments):
    monkeypatch.setattr("sys.argv", ["beamsplat", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


def test_slam_without_a_usable_scan(blind, tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, "slam", blind, "--out", tmp_path / "map") == 3
    assert "no scan could be used" in capsys.readouterr().err


def test_depth_of_damaged_images(blind, tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, "depth", blind, "--out", tmp_path / "depth", "--every", "1", "--json") == 3
    said = capsys.readouterr()
    assert "no image has depth" in said.err
    assert json.loads(said.out)["with_depth"] == 0


@pytest.mark.slow
def test_a_demo_without_a_pose(blind, tmp_path, free_endpoint, monkeypatch, capsys):
    options = (
        f'router.listen=["{free_endpoint}"]',
        f'state_dir="{tmp_path / "state"}"',
        "monitor.grpc_port=0",
    )
    sets = [word for option in options for word in ("--set", option)]
    assert run(monkeypatch, "demo", "--data", blind, "--out", tmp_path / "out", *sets) == 3
    assert "the run has no pose" in capsys.readouterr().err
