"""Samples of processes over time, and what `bench laps` calls growth."""

import csv
import os
import subprocess
import sys

import numpy as np

from beamsplat.tools.bench.laps import MEMORY_MB, lap_findings
from beamsplat.tools.bench.process_samples import ProcessSample, ProcessSamples

GROWING = """
import sys, time
blocks = []
for line in sys.stdin:
    blocks.append(bytearray(b"x") * 20_000_000); blocks.append(open("/dev/null")); print("grown", flush=True)
"""


def test_samples_show_the_memory_and_descriptors_that_a_process_takes(tmp_path):
    samples = ProcessSamples()
    with subprocess.Popen([sys.executable, "-c", GROWING], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                          text=True) as process:  # fmt: skip
        for time_s in range(4):
            process.stdin.write("\n")
            process.stdin.flush()
            assert process.stdout.readline() == "grown\n"
            samples.take(time_s, {"growing": process.pid, "this": os.getpid(), "gone": 2**22 - 1})
        process.stdin.close()
    assert set(samples.series) == {"growing", "this"}
    np.testing.assert_allclose(np.diff(samples.values("growing", "private_mb")), 20.0, atol=1.0)
    assert set(np.diff(samples.values("growing", "descriptors"))) == {1}
    samples.write_csv(tmp_path / "samples.csv")
    rows = list(csv.DictReader((tmp_path / "samples.csv").open()))
    assert len(rows) == 8
    assert float(rows[3]["private_mb"]) > 80.0
    assert all("<polyline" in chart for chart in samples.charts())


def test_quarters_are_of_the_time_and_not_of_the_number_of_samples():
    samples = ProcessSamples({"early": [ProcessSample(t, 1, t, t, 3, 1, 0.0) for t in (0.0, 1.0, 2.0, 3.0, 4.0)],
                              "late": [ProcessSample(t, 2, t, t, 3, 1, 0.0) for t in (6.0, 8.0)]})  # fmt: skip
    assert samples.quarter("early", "private_mb", 2).tolist() == [2.0, 3.0, 4.0]
    assert samples.quarter("early", "private_mb", 4).tolist() == []
    assert samples.quarter("late", "private_mb", 4).tolist() == [6.0, 8.0]


def figures(private_mb, **others):
    return {"private_mb": private_mb, "explained_mb": 0.0, "descriptors": [20, 20], "threads": [10, 10],
            "peak_private_mb": max(private_mb), **others}  # fmt: skip


def test_growth_beyond_two_percent_is_found_and_that_of_the_map_is_not():
    assert not lap_findings({"page": figures([100.0, 101.9])})
    assert "page grew from 100.0 to 102.1 MB" in lap_findings({"page": figures([100.0, 102.1])})[0]
    assert not lap_findings({"localization": figures([100.0, 110.0], explained_mb=8.5)})
    assert not lap_findings({"mapping": figures([300.0, MEMORY_MB - 1.0])})
    assert "mapping took 601 of 600 MB" in lap_findings({"mapping": figures([300.0, MEMORY_MB + 1.0])})
    assert not lap_findings({"page": figures([100.0, 100.0], descriptors=[20, 22], threads=[10, 12])})
    found = lap_findings({"page": figures([100.0, 100.0], descriptors=[20, 23], threads=[10, 13])})
    assert found == ["page: 23 descriptors, before 20", "page: 13 threads, before 10"]
