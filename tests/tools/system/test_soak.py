"""The whole system for a long time; `make soak`. BEAMSPLAT_SOAK_MINUTES says how long each test runs (20)."""

import os

import pytest

from beamsplat.tools.bench.faults.campaign import bench_faults
from beamsplat.tools.bench.laps import bench_laps

MINUTES = float(os.environ.get("BEAMSPLAT_SOAK_MINUTES", "20"))


@pytest.mark.soak
def test_laps_on_end_cost_no_more_memory_and_no_more_files(tmp_path, free_endpoint):
    report = bench_laps(None, MINUTES, tmp_path, free_endpoint, print)
    assert not report["findings"], report["findings"]


@pytest.mark.soak
def test_random_faults_stop_neither_robot_nor_edge(tmp_path):
    report = bench_faults(None, MINUTES, 0, tmp_path, 1.0, print)
    assert not report["findings"], report["findings"]
