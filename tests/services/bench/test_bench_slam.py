"""What the bench of the lidar SLAM takes, and what it leaves behind."""

import json

import pytest

from common.errors import UserError
from services.bench.slam import BEGIN, END, into_readme, markdown, recordings_in
from tests.services.test_cli import beamsplat

ROW = {
    "name": "aces", "translation_mean_m": 0.0348, "translation_std_m": 0.031, "rotation_mean_deg": 0.36,
    "cpu_ms_per_scan": 5.42, "step_p95_ms": 8.2, "peak_rss_mb": 455.8,
}  # fmt: skip


def test_recordings_are_found_by_their_truth(tmp_path):
    with pytest.raises(UserError, match="neither"):
        recordings_in(tmp_path)
    for name in (
        "logs/a.bag",
        "logs/a.relations",
        "logs/lonely.relations",
        "home/bag/x",
        "home/groundtruth.txt",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    names = [(name, truth[0]) for name, _, truth in recordings_in(tmp_path)]
    assert names == [("a", "--relations"), ("home", "--groundtruth")]


def test_the_table_goes_between_its_marks(tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    into_readme(readme, markdown([ROW]))
    text = readme.read_text()
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert "old" not in text
    assert "| aces | 0.0348 ± 0.0310 | 0.360 | 0.0375 m, 0.373° | 5.4 | 8.2 | 456 |" in text
    readme.write_text("nothing")
    with pytest.raises(UserError, match="between"):
        into_readme(readme, "table")


@pytest.mark.slow
def test_the_house(shared_dir, tmp_path):
    done = beamsplat("bench", "slam", "--data", shared_dir / "data" / "house_a", "--out", tmp_path, "--json")
    rows = json.loads(done.stdout)
    assert [row["name"] for row in rows] == ["house_a"]
    assert rows[0]["ate_first_pose_rmse_m"] < 0.015
    assert rows[0]["online_ate_first_pose_rmse_m"] < 0.015
    assert rows[0]["yaw_rmse_rad"] < 0.003
    assert (tmp_path / "maps.jpg").stat().st_size > 2000

    found = beamsplat("eval", "relocalize", tmp_path / "house_a", shared_dir / "data" / "house_a", "--json")
    figures = json.loads(found.stdout)
    assert figures["scans"] == 100
    assert figures["right_share"] >= 0.95
    assert figures["wrong_and_sure"] == 0
