"""`bench slam`: accuracy and cost of the lidar SLAM on recordings with ground truth.

Each recording is processed in a new process, so that its CPU time and memory can be measured.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.trajectory import read_tum

# Mean absolute errors of Cartographer over the same relations as published (Hess et al. 2016, table II).
CARTOGRAPHER = {
    "aces": (0.0375, 0.373),
    "intel": (0.0229, 0.453),
    "fr079": (0.0452, 0.538),
    "mit-killian": (0.0395, 0.352),
}
COLUMNS = (
    "recording", "error, m", "error, deg", "Cartographer as published", "CPU ms per scan",
    "p95 of a step, ms", "memory, MB",
)  # fmt: skip
COSTS = (("cpu_ms_per_scan", 1), ("step_p95_ms", 1), ("peak_rss_mb", 0))
MAX_RISE_M, MAX_TILT_DEG = 0.2, 5.0  # of recordings that count as planar
TILE_PX = 480  # side of one map in the overview image


def recordings_in(folder: Path) -> list[tuple[str, Path, list[str]]]:
    """Find recordings with ground truth: X.bag beside X.relations, and folders with bag/ and groundtruth.txt.

    Returns:
        For each recording: its name, its path, and the arguments that pass its ground truth to `eval slam`.

    Raises:
        UserError: the folder contains no recording with ground truth.
    """
    found = [
        (path.stem, path.with_suffix(".bag"), ["--relations", str(path)])
        for path in sorted(folder.rglob("*.relations"))
        if path.with_suffix(".bag").exists()
    ]
    found += [
        (path.parent.name, path.parent / "bag", ["--groundtruth", str(path)])
        for path in sorted(folder.rglob("groundtruth.txt"))
        if (path.parent / "bag").exists()
    ]
    if not found:
        raise UserError(f"{folder} contains neither X.bag with X.relations nor bag/ with groundtruth.txt")
    return found


def bench_slam(folder: Path, out: Path, odometry: bool, log: Callable[[str], None]) -> list[dict[str, Any]]:
    """Map every recording in a folder and return its accuracy and cost by name, one row per recording.

    Recordings that are not planar or cannot be mapped are logged and left out.

    Args:
        folder: see `recordings_in`.
        out: folder that receives one folder per recording, with map and trajectories.
        odometry: whether SLAM uses wheel odometry.
        log: receives progress messages.
    """
    rows = []
    for name, bag, truth in recordings_in(folder):
        if truth[0] == "--groundtruth" and (why := _not_planar(Path(truth[1]))):
            log(f"{name}: left out, {why}")
            continue
        row = measure_recording(name, bag, truth, out / name, odometry, log)
        if row is not None:
            rows.append(row)
    return rows


def measure_recording(
    name: str, bag: Path, truth: list[str], out: Path, odometry: bool, log: Callable[[str], None]
) -> dict[str, Any] | None:
    """Map one recording into the folder `out`; return its accuracy and cost, None if it cannot be mapped.

    `truth` are the arguments that pass its ground truth to `eval slam`.

    Raises:
        UserError: the ground truth cannot be used.
    """
    log(f"{name} ...")
    command = ["slam", str(bag), "--out", str(out), "--json", *([] if odometry else ["--no-odometry"])]
    mapped = run_beamsplat(command)
    if mapped.returncode:
        log(f"{name}: left out, {mapped.stderr.strip().splitlines()[-1]}")
        return None
    scored = run_beamsplat(["eval", "slam", str(out), *truth, "--json"])
    if scored.returncode:
        raise UserError(f"{name}: {scored.stderr.strip()}")
    return {"name": name, **json.loads(mapped.stdout), **json.loads(scored.stdout)}


def _not_planar(groundtruth: Path) -> str:
    """Return why a recording is not planar, or "" if it is: a planar SLAM cannot map a hand-held sensor."""
    T_world_body = read_tum(groundtruth).T_a_b
    rise_m = float(np.ptp(T_world_body[:, 2, 3]))
    tilt_deg = float(np.degrees(np.arccos(np.clip(T_world_body[:, 2, 2].min(), -1.0, 1.0))))
    if rise_m < MAX_RISE_M and tilt_deg < MAX_TILT_DEG:
        return ""
    return f"its body rises by {rise_m:.2f} m and tilts by {tilt_deg:.0f} degrees"


def run_beamsplat(arguments: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a `beamsplat` command in a new process and return its output as text."""
    command = [sys.executable, "-m", "beamsplat", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def markdown(rows: list[dict[str, Any]]) -> str:
    """Return the results of `bench_slam` as a Markdown table, the one in the README."""
    lines = [
        "| " + " | ".join(COLUMNS) + " |",
        "|---" * len(COLUMNS) + "|",
    ]
    for row in rows:
        name = row["name"]
        if "translation_mean_m" in row:
            error = f"{row['translation_mean_m']:.4f} ± {row['translation_std_m']:.4f}"
            turn = f"{row['rotation_mean_deg']:.3f}"
        else:
            error = f"{row['ate_first_pose_rmse_m']:.4f} (online {row['online_ate_first_pose_rmse_m']:.4f})"
            turn = f"{np.degrees(row['yaw_rmse_rad']):.3f}"
        theirs = "{:.4f} m, {:.3f}°".format(*CARTOGRAPHER[name]) if name in CARTOGRAPHER else ""
        cost = [f"{row[key]:.{digits}f}" for key, digits in COSTS]
        lines.append("| " + " | ".join([name, error, turn, theirs, *cost]) + " |")
    return "\n".join(lines)


def write_map_overview(out: Path, names: list[str], path: Path) -> None:
    """Write the maps of several recordings side by side, each with its name, into one JPEG file.

    Reads `map.png` in the folder of each name in `out`.
    """
    import cv2

    tiles = []
    for name in names:
        image = cv2.imread(str(out / name / "map.png"))
        assert image is not None  # written by the run before
        scale = (TILE_PX - 30) / max(image.shape[:2])
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        tile = np.full((TILE_PX, TILE_PX, 3), 205, dtype=np.uint8)
        top, left = 30 + (TILE_PX - 30 - small.shape[0]) // 2, (TILE_PX - small.shape[1]) // 2
        tile[top : top + small.shape[0], left : left + small.shape[1]] = small
        cv2.putText(tile, name, (12, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (40, 40, 40), 1, cv2.LINE_AA)
        tiles.append(tile)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.hstack(tiles), [cv2.IMWRITE_JPEG_QUALITY, 82])
