"""Mapping of a whole recording as fast as the machine allows, with measured run times."""

from __future__ import annotations

import json
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import NothingUseful
from beamsplat.common.files.persist import make_folder
from beamsplat.common.geometry.trajectory import Trajectory, write_tum
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.runtime.stamp_merger import StampMerger
from beamsplat.common.status import general_reason
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.job_runner import JobRunner
from beamsplat.services.localization.lidar2d.occupancy import save_nav2
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam

STREAMS = ("odometry", "scan")


@dataclass(frozen=True)
class MeasurementLog:
    """Measurements of a recording in order of arrival. Each is one of these tuples:

    ("scan", stamp_ns, ranges_m, angle_min_rad, angle_increment_rad, time_increment_s, range_min_m,
        range_max_m)
    ("odometry", stamp_ns, x_m, y_m, yaw_rad)
    """

    T_body_lidar: np.ndarray  # float64 [4, 4]
    measurements: Iterable[tuple]
    advance: Callable[[], None]  # called once per measurement, for a progress bar


def map_measurements(
    log: MeasurementLog, out: Path, resolution_m: float = 0.05, settings: LidarSlamSettings | None = None
) -> dict[str, Any]:
    """Run the SLAM over a recording; write poses, map, state and metrics to `out`; return the metrics.

    The metrics (`figures.json`) are run times, memory use and counts. Background jobs run in a second thread.
    Their results are applied at the scans where they are due, exactly as in the live node.

    Raises:
        NothingUseful: there was no usable scan.
    """
    slam = LidarSlam(settings or LidarSlamSettings(), log.T_body_lidar)
    wall, cpu = time.perf_counter(), time.process_time()
    steps_ms: list[float] = []
    steps_cpu_ms: list[float] = []
    cpu_s_at: list[float] = []  # CPU time of all threads before each scan
    statuses: dict[str, int] = {}
    refused: Counter[str] = Counter()
    heard = False
    with JobRunner(slam, threaded=True) as jobs:
        for kind, *values in _merged(log):
            if kind == "odometry":
                heard = True
                slam.add_odometry(*values)
                continue
            cpu_s_at.append(time.process_time() - cpu)
            jobs.before_scan()
            started, started_cpu = time.perf_counter(), time.thread_time()
            result = slam.add_scan(*values)
            steps_ms.append((time.perf_counter() - started) * 1e3)
            steps_cpu_ms.append((time.thread_time() - started_cpu) * 1e3)
            jobs.after_scan(result)
            status = result.status.partition(":")[0]
            statuses[status] = statuses.get(status, 0) + 1
            if status != "ok":
                refused[general_reason(result.status)] += 1
        jobs.finish()
    cpu_s, wall_s = time.process_time() - cpu, time.perf_counter() - wall
    if slam.record.count == 0:
        raise NothingUseful(f"no scan could be used: {dict(refused) or 'the recording has none'}")
    _write(slam, out, resolution_m)
    figures = {
        "scans": len(steps_ms),
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "cpu_ms_per_scan": cpu_s / len(steps_ms) * 1e3,
        "cpu_ms_per_scan_first_tenth": _cpu_ms_per_scan(cpu_s_at[: len(cpu_s_at) // 10 + 1]),
        "cpu_ms_per_scan_last_tenth": _cpu_ms_per_scan(cpu_s_at[-(len(cpu_s_at) // 10) - 1 :]),
        "step_p50_ms": float(np.percentile(steps_ms, 50)),
        "step_p95_ms": float(np.percentile(steps_ms, 95)),
        "step_max_ms": max(steps_ms),
        "step_max_cpu_ms": max(steps_cpu_ms),  # without the waits of a busy machine
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "loop_closures": slam.pose_graph.loop_closures,
        "gaps_tied_by_odometry": slam.gaps_tied,
        "gaps_open": slam.gaps_open,
        "odometry_refused": slam.motion.odometry.rejected,
        "odometry": asdict(slam.motion.odometry.report()) if heard else None,
        "self_returns": [asdict(sector) for sector in slam.self_returns.sectors()],
        "self_returns_removed": slam.self_returns.removed,
        **{f"scans_{status}": count for status, count in statuses.items()},
        "refused": dict(refused),
        "T_body_lidar": se2.from_matrix(log.T_body_lidar).tolist(),
    }
    (out / "figures.json").write_text(json.dumps(figures, indent=1))
    return figures


def _cpu_ms_per_scan(cpu_s_at: list[float]) -> float:
    """Return the mean CPU time between scans in ms; `cpu_s_at` is the total in s before each of them."""
    return (cpu_s_at[-1] - cpu_s_at[0]) / max(len(cpu_s_at) - 1, 1) * 1e3


def _merged(log: MeasurementLog) -> Iterable[tuple]:
    """Yield the measurements ordered by stamp, with the same merger as the live runner."""
    merger = StampMerger(STREAMS)
    for measurement in log.measurements:
        log.advance()
        merger.put(measurement[0], measurement[1], measurement)
        while (item := merger.pop()) is not None:
            yield item[1]
    for stream in STREAMS:
        merger.end(stream)
    while (item := merger.pop()) is not None:
        yield item[1]


def _write(slam: LidarSlam, out: Path, resolution_m: float) -> None:
    make_folder(out)
    slam.save(out / "state")
    stamps_ns, pose_map_body, published = slam.trajectory()
    for name, poses in (("trajectory.tum", pose_map_body), ("online.tum", published)):
        write_tum(out / name, Trajectory(stamps_ns, se2_to_se3(poses)), "T_map_body")
    save_nav2(slam.grid(resolution_m), out)
