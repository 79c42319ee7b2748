"""Compute the scores of live runs against ground truth, and the report on one run or several runs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import inverse
from beamsplat.tools.evaluation.depth_replay import truth_depth_files
from beamsplat.tools.evaluation.drive import open_drive
from beamsplat.tools.report.map_scores import (
    map_figures,
    map_in_world,
    previews,
    top_view_of_map,
    truth_folder,
)
from beamsplat.tools.report.observer import RunCosts, RunRecord
from beamsplat.tools.report.scores import (
    GroundTruth,
    aligned_poses,
    depth_errors,
    pose_errors,
    rigid_offset,
    speed_and_load,
)


def open_truth(data: Path, groundtruth: Path | None = None) -> GroundTruth:
    """Open a recording with its ground truth.

    True poses are read from `groundtruth` (a TUM file), else from groundtruth.txt beside the bag, else from
    the bag.

    Raises:
        UserError: images, scans or calibration are missing.
    """
    folder = truth_folder(data)
    file = groundtruth or (folder / "groundtruth.txt" if (folder / "groundtruth.txt").is_file() else None)
    bag = folder / "bag" if (folder / "bag").exists() else data
    drive = open_drive(bag, file)
    try:
        depth_files = truth_depth_files(folder)
    except UserError:
        depth_files = {}
    return GroundTruth(folder, drive, depth_files)


def score_run(record: RunRecord, costs: RunCosts, truth: GroundTruth) -> dict[str, Any]:
    """Return all scores and costs of one run by name; `plots` contains the data of the report's plots."""
    stamps, T_found, T_true = aligned_poses(record, truth)
    row = (
        speed_and_load(record, costs, os.cpu_count() or 1)
        | pose_errors(T_found, T_true)
        | depth_errors(record, truth)
    )
    T_world_map = None
    if len(T_found):
        first = next(T for _, T, status, _ in record.poses if status == "ok")
        T_world_map = rigid_offset(T_found, T_true) @ T_found[0] @ inverse(first)
    figures, offpath = ({}, []) if T_world_map is None else map_figures(record, truth, T_world_map)
    ends = [s.psnr_db for s in record.statuses if np.isfinite(s.psnr_db)]
    row |= figures | {"psnr_keyframes_db": float(np.mean(ends)) if ends else None}
    row["plots"] = {
        "stamps_ns": stamps, "found": T_found, "true": T_true, "offpath": offpath,
        "previews": previews(record, 4),
        "estimates": record.kept_estimates, "fused": record.kept_fused,
        "above": None if T_world_map is None else top_view_of_map(record, T_world_map, T_found[:, :2, 3]),
        "map": None if T_world_map is None else map_in_world(record, T_world_map),
    }  # fmt: skip
    return row


def single_run_report(
    name: str, title: str, data: Path, truth: GroundTruth, row: dict[str, Any]
) -> dict[str, Any]:
    """Return the report on a single run that is not one of the paper's configurations.

    `row` is the result of `score_run`.
    """
    whole = {
        "name": name, "title": title, "seed": None, "paper": {}, "partner": None, "lidar": True,
        "depth_source": title, "advice": "", "status": "ok", **row,
    }  # fmt: skip
    return report_of_runs([whole], data.parent if data.name == "bag" else data, truth)


def report_of_runs(rows: list[dict[str, Any]], data: Path, truth: GroundTruth) -> dict[str, Any]:
    """Return the report on scored runs as `beamsplat.tools.report.html.write_report` expects it.

    `rows` are results of `score_run`, each with the entries that describe its configuration.
    """
    return {
        "data": data.name, "cores": os.cpu_count(), "truth": truth.drive.poses_name.rsplit("/", 1)[-1],
        "configurations": rows, "pairs": compare_pairs(rows),
    }  # fmt: skip


def compare_pairs(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the ratios of CPU load, speed and position error: lidar divided by camera localization.

    There is one entry per pair of configurations with the same depth source; values are means over its runs.
    """
    means = {name: _means([r for r in rows if r["name"] == name]) for name in {r["name"] for r in rows}}
    out = []
    for row in {r["name"]: r for r in rows}.values():
        a, b = means.get(row["name"]), means.get(row.get("partner") or "")
        if not a or not b:
            continue
        out.append({
            "lidar": row["name"], "camera": row["partner"],
            "cpu_load_ratio": _ratio(a, b, "cpu_load_percent"),
            "cpu_s_per_located_image_ratio": _ratio(a, b, "cpu_s_per_located_image"),
            "fps_ratio": _ratio(a, b, "fps"), "position_ratio": _ratio(a, b, "position_rmse_m"),
        })  # fmt: skip
    return out


def _means(rows: list[dict[str, Any]]) -> dict[str, float]:
    names = ("cpu_load_percent", "fps", "position_rmse_m", "cpu_s_per_located_image")
    values = {name: [r[name] for r in rows if r.get(name) is not None] for name in names}
    return {name: float(np.mean(v)) for name, v in values.items() if v}


def _ratio(a: dict[str, float], b: dict[str, float], name: str) -> float | None:
    return a[name] / b[name] if name in a and b.get(name) else None
