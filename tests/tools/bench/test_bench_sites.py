"""`bench sites`: names, table, and a small floor from the simulation to the table."""

import pytest

from beamsplat.common.errors import UserError
from beamsplat.tools.bench.sites import bench_sites, markdown

ROW = {
    "name": "aliased", "ate_se3_rmse_m": 0.0871, "online_ate_se3_rmse_m": 0.2, "loops_wrong": 2, "loops_in_graph": 810,
    "revisits": 3000, "revisit_recall": 0.934, "scans": 2000, "scans_ok": 1900, "cpu_ms_per_scan_first_tenth": 7.04,
    "cpu_ms_per_scan_last_tenth": 7.5, "step_max_cpu_ms": 61.4, "peak_rss_mb": 431.3,
}  # fmt: skip


def test_the_table_shows_errors_wrong_closures_and_costs():
    lines = markdown([ROW]).split("\n")
    assert lines[0].count("|") == lines[1].count("|") == lines[2].count("|")
    assert lines[2] == "| aliased | 0.087 | 0.200 | 2 of 810 | 93.4% of 3000 | 5.0% | 7.0 | 7.5 | 61 | 431 |"


def test_an_unknown_floor_is_named(tmp_path):
    with pytest.raises(UserError, match="shed: unknown; known are office"):
        bench_sites(tmp_path, ["shed"], "120x80", 3000.0, lambda _: None)


@pytest.mark.slow
def test_a_small_floor_is_simulated_mapped_and_scored(tmp_path):
    rows = bench_sites(tmp_path, ["office"], "40x30", 20.0, lambda _: None)
    assert rows[0]["ate_se3_rmse_m"] < 0.05
    assert rows[0]["loops_wrong"] == 0
    assert rows[0]["scans_ok"] == rows[0]["scans"]
    assert "| office |" in markdown(rows)
    # A second run maps the same recording again.
    before = (tmp_path / "office-40x30-20m" / "recording" / "groundtruth.txt").stat().st_mtime_ns
    again = bench_sites(tmp_path, ["office"], "40x30", 20.0, lambda _: None)
    assert (tmp_path / "office-40x30-20m" / "recording" / "groundtruth.txt").stat().st_mtime_ns == before
    assert again[0]["ate_se3_rmse_m"] == rows[0]["ate_se3_rmse_m"]
