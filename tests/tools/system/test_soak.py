"""The whole system on one lap after another: no process grows and none hoards files; `make soak`.

BEAMSPLAT_SOAK_MINUTES says how long (20).
"""

import os
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import psutil
import pytest

from beamsplat.common.config.deployment import load_deployment
from beamsplat.common.zenoh.bus import open_session
from beamsplat.tools.cli.simulate import simulate
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor

ROOT = Path(__file__).resolve().parents[3]
MINUTES = float(os.environ.get("BEAMSPLAT_SOAK_MINUTES", "20"))
EVERY_S = 5.0


def proportional_mb(pid):
    """Memory of a process, what it shares counted in parts."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) / 1e3
    raise AssertionError(f"no Pss of process {pid}")


@pytest.mark.soak
def test_laps_on_end_cost_no_more_memory_and_no_more_files(tmp_path, free_endpoint):
    simulate(tmp_path / "lap", laps=1, jobs=2)
    deployment = load_deployment(ROOT / "deploy" / "demo.toml", (
        f"replay.data={tmp_path / 'lap' / 'bag'}", "replay.loop=true", f"recorder.out={tmp_path / 'recording'}",
        f"mapping.session={tmp_path / 'session'}", "mapping.memory_mb=600", f'router.listen=["{free_endpoint}"]',
        f"state_dir={tmp_path / 'state'}", f"monitor.save={tmp_path / 'seen.rrd'}", "monitor.viewer_memory_mb=64", "monitor.view=serve", "monitor.grpc_port=0", "monitor.web_port=0",
    ))  # fmt: skip
    memory_mb, files, threads = (defaultdict(list) for _ in range(3))
    with Supervisor(deployment) as supervisor, open_session(deployment.router.listen) as session:
        board, end = HealthTable(session, deployment.robot), time.monotonic() + MINUTES * 60.0
        while time.monotonic() < end:
            next_look = time.monotonic() + EVERY_S
            for name, child in supervisor.children.items():
                process = psutil.Process(child.process.pid)
                memory_mb[name].append(proportional_mb(process.pid))
                files[name].append(process.num_fds())
                threads[name].append(process.num_threads())
            while time.monotonic() < next_look:
                supervisor.poll()
                time.sleep(0.2)
        restarts = {name: child.restarts for name, child in supervisor.children.items()}
        states, detail = board.states(), board.records["mapping"].health.detail
    print(f"\n{MINUTES:g} min; {detail}")
    faults = []
    for name, series in memory_mb.items():
        quarter = len(series) // 4
        early, late = np.mean(series[quarter : 2 * quarter]), np.mean(series[-quarter:])
        noise = 3.0 * np.std(series[-quarter:])
        fds = (max(files[name][quarter : 2 * quarter]), max(files[name][-quarter:]))
        tasks = (max(threads[name][quarter : 2 * quarter]), max(threads[name][-quarter:]))
        print(f"{name:13} {early:6.0f} -> {late:6.0f} MB (3 sigma {noise:.0f}), files {fds}, threads {tasks}")
        if late - early > max(noise, 0.03 * early, 5.0):
            faults.append(f"{name} grew from {early:.0f} to {late:.0f} MB")
        if fds[1] > fds[0] + 2 or tasks[1] > tasks[0] + 2:
            faults.append(f"{name}: files {fds}, threads {tasks}")
    assert not any(restarts.values()), restarts
    assert set(states.values()) == {"active"}, states
    assert not faults, faults
