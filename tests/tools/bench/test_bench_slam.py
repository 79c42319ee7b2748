"""`bench slam`: recordings that it finds, tables that it writes."""

import json

import pytest

from beamsplat.common.errors import UserError
from beamsplat.tools.bench.readme import paper_table, replace_readme_table
from beamsplat.tools.bench.slam import markdown, recordings_in
from tests.tools.cli.test_cli import beamsplat

ROW = {
    "name": "aces", "translation_mean_m": 0.0348, "translation_std_m": 0.031, "rotation_mean_deg": 0.36,
    "cpu_ms_per_scan": 5.42, "step_p95_ms": 8.2, "peak_rss_mb": 455.8,
}  # fmt: skip


def test_recordings_are_found_by_their_ground_truth(tmp_path):
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


def test_the_table_is_written_between_its_marks(tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text("before\n<!-- bench slam -->\nold\n<!-- /bench slam -->\nafter\n")
    replace_readme_table(readme, "slam", markdown([ROW]))
    text = readme.read_text()
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert "old" not in text
    assert "| aces | 0.0348 ± 0.0310 | 0.360 | 0.0375 m, 0.373° | 5.4 | 8.2 | 456 |" in text
    readme.write_text("nothing")
    with pytest.raises(UserError, match="between"):
        replace_readme_table(readme, "paper", "table")


def test_the_papers_table_has_its_figures_in_brackets():
    rows = [
        {"title": "UniDepth + lidar", "advice": "weights missing", "depth_source": "FastDepth instead of the network",
         "position_rmse_m": 0.00725, "fps": 9.91, "cpu_s_per_image": 0.15, "depth_rmse_scaled_m": 0.4012,
         "psnr_offpath_db": 18.04, "keyframe_latency_p95_ms": 812.0, "peak_rss_mb": 1024.4,
         "paper": {"position_rmse_m": 0.0784, "fps": 2.176, "cpu_load_percent": 1024, "depth_rmse_scaled_m": 0.398}},
        {"title": "default", "advice": "", "depth_source": "", "paper": {}, "psnr_offpath_db": 23.2,
         "refined_psnr_offpath_db": 24.5},
    ]  # fmt: skip
    first, second = paper_table(rows).split("\n")[2:]
    assert first == (
        "| UniDepth + lidar [FastDepth instead of the network] | 0.0073 (0.0784) | 9.9 (2.2) | 0.15 (4.71) "
        "| 0.40 (0.40) | 18.0 | 0.8 | 1024 |"
    )
    assert second == "| default | – | – | – | – | 23.2, refined 24.5 | – | – |"


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
