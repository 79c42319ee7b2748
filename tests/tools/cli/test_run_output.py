"""A run into a file says how it is going while it goes; `top --json` is one object."""

import json
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
_RUN = """
    import sys
    from pathlib import Path
    from beamsplat.common.config.deployment import Deployment, RouterConfig
    from beamsplat.services import nodes
    from beamsplat.tools.cli import system as system_cli
    from tests.common.nodes import TABLE

    nodes.NODES.clear()
    nodes.NODES.update(TABLE)
    system_cli.STATUS_S = 0.5
    system_cli.run_checked(Deployment(
        robot="test", router=RouterConfig(listen=(sys.argv[1],)), state_dir=Path(sys.argv[2]),
        nodes={"replay": {"kind": "drive", "seconds": 120.0}, "localization": {"kind": "chain"}},
    ))
"""


@pytest.fixture
def run(tmp_path, free_endpoint):
    """(endpoint, file that the run writes to)."""
    file = tmp_path / "log"
    command = [sys.executable, "-c", textwrap.dedent(_RUN), free_endpoint, tmp_path / "state"]
    with file.open("w") as output:
        process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output)
    yield free_endpoint, file
    process.terminate()
    process.wait(30)


def test_a_run_into_a_file_writes_status_lines_at_once_and_top_gives_one_json_object(run, tmp_path):
    endpoint, file = run
    deadline = time.monotonic() + 40
    while "localization active" not in file.read_text() and time.monotonic() < deadline:
        time.sleep(0.2)
    lines = file.read_text().splitlines()
    assert any("localization active" in line and " Hz" in line for line in lines), lines
    (tmp_path / "d.toml").write_text(f'robot = "test"\n[router]\nlisten = ["{endpoint}"]\n')
    done = subprocess.run(
        [sys.executable, "-m", "beamsplat", "top", tmp_path / "d.toml", "--json", "--seconds", "2.5"],
        cwd=ROOT, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    table = json.loads(done.stdout)
    node = table["nodes"]["localization"]
    assert node["state"] == "active"
    assert node["pid"] > 0
    assert {"in_hz", "out_hz", "step_p50_ms", "age_ms", "rss_mb", "cpu_percent", "lost"} <= node.keys()
    scans = table["topics"]["lidar/scan"]
    assert scans["producer"] == "replay"
    assert scans["nominal_hz"] == 10.0
    assert "localization" in scans["consumers"]
