"""The end of a run says what was refused, by node and reason; exit code 3 if nothing useful came out."""

import json
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.messages import Health, InputHealth, Odometry, OutputHealth, Rejected
from beamsplat.common.runtime.health import HealthRecords
from beamsplat.common.runtime.registry import Service
from beamsplat.common.runtime.rejections import MOST_REASONS, OTHER, Rejections
from beamsplat.tools.system.run_summary import RunSummary
from tests.common.nodes import TABLE, Chain

ROOT = Path(__file__).resolve().parents[3]


class HalfConfig(NodeConfig):
    useful: bool = True


class Half(Chain):
    """Rejects every second scan, or all."""

    Config = HalfConfig
    config: HalfConfig

    def on_lidar_scan(self, scan):
        self._jobs += 1
        bad = self._jobs % 2 == 1 or not self.config.useful
        yield (
            "localization/odometry",
            Odometry(stamp_ns=scan.stamp_ns, T_odom_body=np.eye(4), covariance=np.eye(3),
                     status="rejected" if bad else "ok",
                     detail=f"{self._jobs} returns; at least 20 are needed" if bad else ""),
        )  # fmt: skip


OWN = {
    **TABLE,
    "localization": Service("localization", "", {"half": "tests.tools.system.test_run_summary:Half"}),
}
_MAIN = """
    import sys
    from beamsplat.services import nodes
    from tests.tools.system.test_run_summary import OWN
    nodes.NODES.update(OWN)
    from beamsplat.tools.cli.main import main
    main()
"""
REASON = "localization/odometry: rejected: N returns; at least N are needed"


def run(tmp_path, endpoint, *command, useful=True):
    file = tmp_path / "d.toml"
    file.write_text(
        f'robot = "r1"\nstate_dir = "{tmp_path / "state"}"\nrate = 0.0\n[router]\nlisten = ["{endpoint}"]\n'
        "[nodes.replay]\nkind = 'drive'\nseconds = 4.0\nimages = false\n"
        f"[nodes.localization]\nkind = 'half'\nuseful = {str(useful).lower()}\n"
    )
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(_MAIN), command[0], str(file), *command[1:]],
        cwd=ROOT, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("useful", [True, False])
def test_a_live_run_prints_what_was_refused(tmp_path, free_endpoint, useful):
    done = run(tmp_path, free_endpoint, "run", useful=useful)
    shown = [line for line in done.stderr.splitlines() if REASON in line]
    assert shown, done.stderr
    assert shown[-1].split()[:2] == ["localization", "20" if useful else "40"]
    assert done.returncode == (0 if useful else 3)
    assert ("the run has no pose" in done.stderr) == (not useful)


@pytest.mark.parametrize("useful", [True, False])
def test_an_offline_run_prints_it_and_has_it_in_its_json(tmp_path, free_endpoint, useful):
    out = tmp_path / "out"
    done = run(tmp_path, free_endpoint, "offline", "--out", str(out), "--json", useful=useful)
    assert done.returncode == (0 if useful else 3), done.stderr
    assert REASON in done.stderr
    summary = json.loads(done.stdout)
    assert summary["refused"]["localization"][REASON] == (20 if useful else 40)
    assert summary == json.loads((out / "summary.json").read_text())


def test_reasons_are_bounded_and_have_no_numbers():
    rejections = Rejections()
    for number in range(3):
        rejections.add(f"keyframe {number} is {number / 7:.3f} m off", "mapping/status")
    assert rejections.report() == (Rejected(topic="mapping/status", reason="keyframe N is N m off", count=3),)
    for number in range(1000):
        rejections.add("x" * number)
    report = rejections.report()
    assert len(report) <= MOST_REASONS + 1
    assert sum(entry.count for entry in report) == 1003
    assert any(entry.reason == OTHER for entry in report)
    for total in (0, 4, 7):
        rejections.set("images overtaken", total)
    assert [entry.count for entry in rejections.report() if entry.reason == "images overtaken"] == [7]


def test_counts_of_a_process_that_was_restarted_or_failed_stay():
    book = HealthRecords()

    def health(instance, state="active", dropped=0, sent=0, refused=0):
        entry = InputHealth(
            topic="lidar/scan", received=9, dropped=dropped, lost=0, undecodable=0, stale=0, age_ms=0.0
        )
        return Health(
            stamp_ns=1, node="localization", instance=instance, epoch=1, state=state,
            inputs=(entry,) if state == "active" else (),
            outputs=(OutputHealth(topic="localization/odometry", sent=sent, bytes=1),) if sent else (),
            rejected=(Rejected(topic="localization/odometry", reason="lost", count=refused),) if refused else (),
        )  # fmt: skip

    now = 0.0
    for report in (
        health("a1", dropped=2, sent=5, refused=5), health("a1", "failed"), health("a1", "failed"),
    ):  # fmt: skip
        book.add(report, now)
        now += 1.0
    summary = RunSummary.of_records(book.records, {"localization": "the map has gone"})
    counts = summary.losses["localization"]
    assert counts["localization/odometry: lost"] == 5
    assert counts["cannot run: the map has gone"] == 1
    assert sum(counts.values()) == 8
    assert summary.missing == ("pose",)
