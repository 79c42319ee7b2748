"""`beamsplat demo`: the whole system on a simulated drive, or on a recording of your own."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import psutil
import typer
from rich.console import Console

from beamsplat.common.config.deployment import load_deployment
from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.common.files.resources import shipped_file
from beamsplat.tools.cli.browser import BrowserOption, open_in_browser
from beamsplat.tools.cli.memory_option import GpuMemoryOption, MemoryOption, memory_overrides
from beamsplat.tools.cli.options import writable

if TYPE_CHECKING:
    from beamsplat.tools.report.observer import RunCosts, RunRecord
    from beamsplat.tools.system.supervisor import Supervisor

DEPLOYMENT = shipped_file("demo.toml")
console = Console(stderr=True)
_CORES_OF_OTHERS = 0.4  # used by other programs: beyond that a note says that the figures suffer
SHOWN = (
    ("keyframes", "keyframes", 0, ""), ("gaussians", "Gaussians", 0, ""),
    ("psnr_keyframes_db", "PSNR at keyframes", 1, " dB"), ("psnr_offpath_db", "off the path", 1, " dB"),
    ("ate_first_pose_rmse_m", "position error", 3, " m"), ("fps", "pictures through the system", 1, "/s"),
    ("keyframe_latency_p95_ms", "keyframe latency p95", 0, " ms"),
    ("cpu_load_percent", "CPU", 0, " %"), ("peak_rss_mb", "memory", 0, " MB"),
)  # fmt: skip
POSE_FIGURES = frozenset({
    "position_rmse_m", "position_rmse_xyz_m", "orientation_rmse_rad", "orientation_rmse_rpy_rad",
    "ate_first_pose_rmse_m", "ate_se3_rmse_m", "ate_sim3_rmse_m", "sim3_scale",
})  # fmt: skip


def demo(
    out: Annotated[Path, typer.Option(callback=writable, help="Folder for everything the demo makes")] = Path(
        "out/demo"
    ),
    data: Annotated[Path | None, typer.Option(help="Your own bag, recording or folder")] = None,
    seconds: Annotated[float, typer.Option(min=1.0, max=3600.0, help="Length of the simulated drive")] = 30.0,
    rate: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Times real time; 0 = as fast as possible")
    ] = 1.0,
    view: Annotated[str, typer.Option(help="none, spawn (a window) or serve (a web viewer)")] = "none",
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="NODE.OPTION=VALUE", help="Override an option")
    ] = None,
    memory: MemoryOption = None,
    browser: BrowserOption = True,
    gpu_memory: GpuMemoryOption = None,
) -> None:
    """Simulate a drive through a furnished home, run the system on it live, and record it.

    At the end the report is opened in a browser, where there is a display.

    Examples:

        beamsplat demo

        beamsplat demo --data drive/bag --view spawn
    """
    from beamsplat.tools.cli.system import run_checked
    from beamsplat.tools.report.observer import RunObserver

    source = data if data is not None else _simulated(out, seconds)
    make_folder(out)
    for old in ("recording", "map", "session"):
        shutil.rmtree(out / old, ignore_errors=True)
    for old in ("demo.rrd", "map.png", "trajectory.tum", "report.html", "report.json"):
        (out / old).unlink(missing_ok=True)
    overrides = (
        f"replay.data={json.dumps(str(source))}",
        f"recorder.out={json.dumps(str(out / 'recording'))}",
        f"monitor.save={json.dumps(str(out / 'demo.rrd'))}",
        f"monitor.view={json.dumps(view)}",
        f"mapping.save={json.dumps(str(out / 'map'))}",
        f"mapping.session={json.dumps(str(out / 'session'))}",
        f"rate={rate}",
        *memory_overrides(memory, gpu_memory),
        *(set_ or ()),
    )
    deployment = load_deployment(DEPLOYMENT, overrides)
    if deployment.nodes["localization"].get("kind") == "lidar":  # the robot's half of the session
        options = {"save": str(out / "session" / "robot"), **deployment.nodes["localization"]}
        nodes = {**deployment.nodes, "localization": options}
        deployment = deployment.model_copy(update={"nodes": nodes})
    seen_by: list[RunObserver] = []

    def monitor(supervisor: Supervisor) -> RunObserver:
        seen_by.append(RunObserver(supervisor, deployment, _truth_stamps(source)))
        return seen_by[0]

    busy_s, began = _busy_s(), time.monotonic()
    end = run_checked(deployment, monitor=monitor)
    costs = seen_by[0].costs
    others_s = _busy_s() - busy_s - costs.startup_cpu_s - sum(costs.cpu_s.values())
    console.print("the recording has ended; writing the report")
    figures = write_results(out, source, seen_by[0].record, costs, end.losses)
    _say_where(out, source, figures)
    cores = others_s / (time.monotonic() - began)
    if cores > _CORES_OF_OTHERS:
        console.print(
            f"Other programs took {cores:.1f} of {os.cpu_count()} CPU cores meanwhile: on an idle machine "
            "more images are processed, with less delay, and the map is better."
        )
    if browser and (out / "report.html").exists():
        open_in_browser((out / "report.html").resolve().as_uri())
    end.check_useful()


def _busy_s() -> float:
    """Return the CPU time in s that all cores of this computer have been busy since it was started."""
    times = psutil.cpu_times()
    return sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0)


def _simulated(out: Path, seconds: float) -> Path:
    """Return the bag of a simulated drive of `seconds` in `out`; simulate the drive if it is missing."""
    from beamsplat.tools.cli.simulate import simulate

    folder = out / f"simulated-{seconds:g}s"
    if not folder.exists():  # the simulator writes a complete folder or none
        simulate(folder, seconds=seconds)
    return folder / "bag"


def _truth_stamps(source: Path) -> frozenset[int]:
    from beamsplat.tools.evaluation.depth_replay import truth_depth_files
    from beamsplat.tools.report.map_scores import truth_folder

    try:
        return frozenset(truth_depth_files(truth_folder(source)))
    except UserError:
        return frozenset()


def write_results(
    out: Path, source: Path, record: RunRecord, costs: RunCosts, losses: dict[str, dict[str, int]]
) -> dict[str, Any]:
    """Write the results of a live run into `out`; return scores and costs by name, as in report.json.

    The files are trajectory.tum and, if there were images, map.png, report.html and report.json. Pose errors
    are computed against the ground truth of the recording (groundtruth.txt beside the bag, or poses in the
    bag); they are left out if it has none.

    Args:
        source: the recording that was played.
        record: messages of the run.
        costs: CPU time and memory of the run.
        losses: what was refused, dropped and lost, by node and reason.
    """
    import cv2
    import numpy as np

    from beamsplat.common.geometry.trajectory import Trajectory, write_tum

    poses = [(stamp_ns, T) for stamp_ns, T, status, _ in record.poses if status == "ok"]
    if not poses:
        return {}
    stamps_ns, T_map_body = np.array([s for s, _ in poses]), np.array([T for _, T in poses])
    order = np.argsort(stamps_ns, kind="stable")
    trajectory = Trajectory(stamps_ns[order], T_map_body[order])
    write_tum(out / "trajectory.tum", trajectory, "T_map_body as it was said live")
    if not record.images:
        return {}
    from beamsplat.tools.evaluation.drive import has_poses
    from beamsplat.tools.report.drive_report import write_drive_report
    from beamsplat.tools.report.run_report import open_truth, score_run, single_run_report

    known = has_poses(source)
    truth = open_truth(source, None if known else out / "trajectory.tum")
    row = score_run(record, costs, truth)
    if not known:
        row = {name: value for name, value in row.items() if name not in POSE_FIGURES}
    if row["plots"]["above"] is not None:
        cv2.imwrite(str(out / "map.png"), row["plots"]["above"])
    report = single_run_report("demo", "lidar + fused depth", source, truth, row)
    write_drive_report(out / "report.html", report, truth)
    figures = {**{name: value for name, value in row.items() if name != "plots"}, "refused": losses}
    write_atomically(out / "report.json", json.dumps(figures, indent=1).encode())
    return figures


def _say_where(out: Path, source: Path, figures: dict[str, Any]) -> None:
    rows = [
        (source, "the drive: camera, lidar, wheels"),
        (out / "report.html", "the results, with the map in 3D: open it in a browser"),
        (out / "map" / "splats.ply", "the map: opens in viewers of 3D Gaussian splats"),
        (out / "map.png", "the map from above"),
        (out / "trajectory.tum", "the trajectory of the robot"),
        (
            out / "session",
            "the saved map, to view, continue or export: beamsplat view, session info, export, render",
        ),
        (out / "demo.rrd", "the view of the monitor: rerun FILE"),
        (out / "recording", "all messages: Foxglove, `ros2 bag`, beamsplat info"),
    ]
    there = [(str(path), what) for path, what in rows if path.exists()]  # no camera, no map
    wide = max(len(path) for path, _ in there)
    print("\n".join(f"{path:{wide}}  {what}" for path, what in there))
    for path in (out / "recording", out / "demo.rrd"):
        if not path.exists():
            raise UserError(f"{path} was not written: the node's log in the state folder says why")
    said = [
        f"{text} {figures[name]:.{digits}f}{unit}"
        for name, text, digits, unit in SHOWN
        if figures.get(name) is not None
    ]
    print(", ".join(said))
