"""`bench laps`: the whole system on one lap after another; memory, descriptors and threads must stay flat."""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.config.deployment import Deployment, load_deployment
from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.common.files.resources import shipped_file
from beamsplat.common.zenoh.bus import open_session
from beamsplat.tools.bench.lap_recording import lap_recording
from beamsplat.tools.bench.process_samples import ProcessSamples
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor

EVERY_S = 5.0  # between two samples
MEMORY_MB = 600.0  # budget of the mapper
FLAT = 0.02  # growth of private memory from the second to the last quarter, as a share
FLAT_MB = 1.0  # growth below this is not a finding: small processes would fail by one arena of the allocator
SPARE = 2  # descriptors and threads that come and go: a query, a file being written
# Processes that hold a whole map in memory (the mapper pages its map), and the size of that map.
HOLDERS = {"localization": "lidar_mb", "monitor": "gaussians"}
Log = Callable[[str], None]
_GAUSSIANS = re.compile(r"(\d+) Gaussians")


@dataclass(frozen=True)
class MapSize:
    """Sizes of both maps at one time."""

    time_s: float
    lidar_mb: float  # checkpoint of the lidar map
    gaussians: float


def lap_deployment(data: Path, out: Path, endpoint: str) -> Deployment:
    """Return the demo with page and durable outbox, on `data` in a loop; all its files are below `out`."""
    paths = {
        "replay.data": data, "recorder.out": out / "recording", "mapping.session": out / "session",
        "monitor.save": out / "seen.rrd", "state_dir": out / "state",
    }  # fmt: skip
    return load_deployment(shipped_file("demo.toml"), (
        *(f"{option}={json.dumps(str(path))}" for option, path in paths.items()),
        f'router.listen=["{endpoint}"]', "replay.loop=true", f"mapping.memory_mb={MEMORY_MB}",
        "keyframes.durable=true", "page.port=0", "monitor.viewer_memory_mb=64", "monitor.view=serve",
        "monitor.grpc_port=0", "monitor.web_port=0",
    ))  # fmt: skip


def bench_laps(data: Path | None, minutes: float, out: Path, endpoint: str, log: Log) -> dict[str, Any]:
    """Run the whole system on laps for `minutes` and sample its processes every `EVERY_S`.

    Writes samples.csv, report.html and report.json into `out`, also of a run that Ctrl-C ends early.

    Args:
        data: recording to play in a loop; None: one simulated lap, made in `out` at the first run.
        out: folder of all files.
        endpoint: Zenoh endpoint of the router that is started.

    Returns:
        "processes" (figures by name), "map", "findings" (texts; empty if everything stayed flat).

    Raises:
        UserError: the data cannot be played, or the system does not start.
    """
    make_folder(out)
    deployment = lap_deployment(data or lap_recording(out, log), out / time.strftime("%H%M%S"), endpoint)
    samples, sizes = ProcessSamples(), list[MapSize]()
    checkpoint = deployment.run_dir / "localization"
    with (
        Supervisor(deployment, on_event=log) as supervisor,
        open_session(deployment.router.listen) as session,
    ):
        table, began, detail = HealthTable(session, deployment.robot), time.monotonic(), ""
        next_log = now = began
        with contextlib.suppress(KeyboardInterrupt):
            while (now := time.monotonic()) < began + minutes * 60.0:
                pids = {name: c.process.pid for name, c in supervisor.children.items()}
                samples.take(now - began, {name: pid for name, pid in pids.items() if pid is not None})
                detail = table.records["mapping"].health.detail if "mapping" in table.records else ""
                sizes.append(MapSize(now - began, _size_mb(checkpoint), _gaussians(detail)))
                if now >= next_log:
                    next_log = now + 60.0
                    log(f"{(now - began) / 60.0:.0f} min: {table.status_line()}")
                while time.monotonic() < now + EVERY_S:
                    supervisor.poll()
                    time.sleep(0.2)
        restarts = {name: child.restarts for name, child in supervisor.children.items() if child.restarts}
        states = table.states()
    report: dict[str, Any] = {
        "minutes": (now - began) / 60.0, "mapping": detail, "processes": _figures(samples, sizes),
        "map": {key: _quarters(sizes, key) for key in ("lidar_mb", "gaussians")},
        "findings": [f"{name} was restarted {n} times" for name, n in restarts.items()]
        + [f"{name} is {state} at the end" for name, state in states.items() if state != "active"],
    }  # fmt: skip
    report["findings"] += lap_findings(report["processes"])
    samples.write_csv(out / "samples.csv")
    write_atomically(out / "report.json", json.dumps(report, indent=1).encode())
    write_atomically(out / "report.html", _page(report, samples).encode())
    return report


def _size_mb(folder: Path) -> float:
    """Return the size of the largest file in a folder; files that are removed meanwhile do not count."""
    largest = 0
    for path in folder.glob("*"):
        with contextlib.suppress(OSError):
            largest = max(largest, path.stat().st_size)
    return largest / 1e6


def _gaussians(detail: str) -> float:
    found = _GAUSSIANS.search(detail)
    return float(found[1]) if found else 0.0


def _quarters(sizes: list[MapSize], key: str) -> tuple[float, float]:
    """Return the median size of a map in the second and in the last quarter of the run."""
    values = np.array([getattr(size, key) for size in sizes])
    quarter = max(len(values) // 4, 1)
    return float(np.median(values[quarter : 2 * quarter + 1])), float(np.median(values[-quarter:]))


def _figures(samples: ProcessSamples, sizes: list[MapSize]) -> dict[str, dict[str, Any]]:
    """Return the figures of the second and the last quarter by process.

    `explained_mb` is the growth that the growth of a map explains, if the memory that the process took since
    its start was in proportion to the map.
    """
    figures = {}
    for name in sorted(samples.series):
        quarters = [
            {figure: samples.quarter(name, figure, number)
             for figure in ("private_mb", "descriptors", "threads")} for number in (2, 4)
        ]  # fmt: skip
        private = [float(np.median(quarter["private_mb"])) for quarter in quarters]
        explained = 0.0
        if name in HOLDERS:
            early, late = _quarters(sizes, HOLDERS[name])
            taken = private[0] - samples.values(name, "private_mb")[0]
            explained = max(taken * (late - early) / early, 0.0) if early else 0.0
        figures[name] = {
            "private_mb": private, "explained_mb": explained,
            "descriptors": [int(quarter["descriptors"].max()) for quarter in quarters],
            "threads": [int(quarter["threads"].max()) for quarter in quarters],
            "peak_private_mb": float(samples.values(name, "private_mb").max()),
            "peak_resident_mb": float(samples.values(name, "resident_mb").max()),
        }  # fmt: skip
    return figures


def lap_findings(figures: dict[str, dict[str, Any]]) -> list[str]:
    """Return what grew, one text per fault; `figures` are the report's "processes"."""
    found = []
    for name, figure in figures.items():
        early_mb, late_mb = figure["private_mb"]
        if name == "mapping":  # its map grows up to the budget, then it is paged
            if figure["peak_private_mb"] > MEMORY_MB:
                found.append(f"mapping took {figure['peak_private_mb']:.0f} of {MEMORY_MB:.0f} MB")
        elif late_mb - early_mb - figure["explained_mb"] > max(FLAT * early_mb, FLAT_MB):
            found.append(
                f"{name} grew from {early_mb:.1f} to {late_mb:.1f} MB; its map explains "
                f"{figure['explained_mb']:.1f} MB"
            )
        for what in ("descriptors", "threads"):
            before, after = figure[what]
            if after > before + SPARE:
                found.append(f"{name}: {after} {what}, before {before}")
    return found


def _page(report: dict[str, Any], samples: ProcessSamples) -> str:
    found = "".join(f"<li>{text}</li>" for text in report["findings"]) or "<li>no finding</li>"
    return (
        "<!doctype html><meta charset=utf-8><title>bench laps</title><style>body{font:14px sans-serif}"
        f"svg text{{font-size:10px}}</style><h1>{report['minutes']:g} minutes of laps</h1><ul>{found}</ul>"
        f"<p>{report['mapping']}</p>{''.join(samples.charts())}"
    )
