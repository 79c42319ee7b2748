"""Command `beamsplat eval relocalize`: success rate and time of relocalizing single scans in a saved map."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.progress import track

from beamsplat.common.errors import UserError
from beamsplat.tools.cli.slam import JsonOption, console, print_figures
from beamsplat.tools.evaluation.slam import planar_poses

if TYPE_CHECKING:
    from beamsplat.services.localization.lidar2d.slam import LidarSlam

MAX_ERROR_M, MAX_ERROR_DEG = 0.30, 5.0  # a pose within these errors is right
MIN_CONFIDENCE = 0.5  # an answer with at least this confidence is used


def eval_relocalize(
    folder: Annotated[Path, typer.Argument(help="Folder written by `beamsplat slam`")],
    bag: Annotated[Path, typer.Argument(help="Bag or recording with the scans")],
    scans: Annotated[int, typer.Option(min=1, help="Number of random scans")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random choice")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Relocalize single scans in a saved map without a prior; success is an error below 0.3 m and 5 degrees.

    The scans are drawn from those between the nodes of the map, which are not part of it. The true poses are
    the mapped trajectory of the same drive: errors of the map itself are not measured.

    Examples:

        beamsplat eval relocalize map drive/bag

        beamsplat eval relocalize map drive/bag --scans 500 --seed 3 --json
    """
    from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
    from beamsplat.services.localization.lidar2d.slam import LidarSlam
    from beamsplat.services.replay.options import SourceOptions
    from beamsplat.services.replay.source import open_source

    stamps_ns, pose_map_body = planar_poses(folder / "trajectory.tum")
    options = SourceOptions(without=frozenset({"image", "pose", "odometry"}), require=frozenset({"scan"}))
    source = open_source(bag, options)
    try:
        lidar = source.rig().lidar
        if lidar is None:
            raise UserError(f"{bag}: the calibration has no lidar")
        slam = LidarSlam.load(folder / "state", LidarSlamSettings(), lidar.T_body_lidar, localize_only=True)
        chosen = _not_nodes(slam, stamps_ns, scans, seed)
        wanted = set(stamps_ns[chosen].tolist())
        found = {
            m.stamp_ns: m
            for _, topic, m in source.messages()
            if topic == "lidar/scan" and m.stamp_ns in wanted
        }
    finally:
        source.close()
    rows = []
    for i in track(chosen, "relocalizing", console=console, transient=True):
        m = found.get(int(stamps_ns[i]))
        if m is None:
            raise UserError(f"{bag} has no scan at {stamps_ns[i]} ns: is {folder} the map of another drive?")
        started, started_cpu = time.perf_counter(), time.thread_time()
        answer = slam.relocalize(
            m.ranges_m, m.angle_min_rad, m.angle_increment_rad, m.range_min_m, m.range_max_m
        )
        rows.append(
            (
                *_error(answer.pose_map_body, pose_map_body[i]),
                answer.confidence,
                time.perf_counter() - started,
                time.thread_time() - started_cpu,
            )
        )
    figures = _summary(np.array(rows))
    print(json.dumps(figures)) if as_json else print_figures(figures)


def _error(pose_map_body: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return the distance in m and the angle in degrees between two planar poses float64 [3] (x, y, yaw)."""
    away = float(np.hypot(*(pose_map_body - truth)[:2]))
    return away, math.degrees(abs(math.remainder(pose_map_body[2] - truth[2], 2.0 * math.pi)))


def _summary(rows: np.ndarray) -> dict[str, Any]:
    """Return success rate, errors and times by name, of N relocalizations.

    `rows` float64 [N, 5]: position error in m, angle error in degrees, confidence, time and CPU time in s.
    """
    right = (rows[:, 0] <= MAX_ERROR_M) & (rows[:, 1] <= MAX_ERROR_DEG)
    sure = rows[:, 2] >= MIN_CONFIDENCE
    return {
        "scans": len(rows),
        "right_share": float(right.mean()),
        "sure_share": float(sure.mean()),
        "wrong_and_sure_share": float((~right & sure).mean()),
        "wrong_and_sure": int((~right & sure).sum()),
        "error_p50_m": float(np.median(rows[:, 0])),
        "error_p50_deg": float(np.median(rows[:, 1])),
        "time_p50_s": float(np.median(rows[:, 3])),
        "time_p95_s": float(np.percentile(rows[:, 3], 95)),
        "cpu_p50_s": float(np.median(rows[:, 4])),  # without the waits of a busy machine
    }


def _not_nodes(slam: LidarSlam, stamps_ns: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Return ascending indices of at most `count` random scans of a drive that are no nodes of its map."""
    nodes_ns = [node.stamp_ns for node in slam.pose_graph.nodes.values()]
    between = np.flatnonzero(~np.isin(stamps_ns, nodes_ns))
    if len(between) == 0:
        raise UserError("every scan is a node of the map: none is left to be relocalized")
    return np.sort(np.random.default_rng(seed).choice(between, min(count, len(between)), replace=False))
