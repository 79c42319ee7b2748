"""`bench paper`: the paper's six configurations and the default one, live, each in its own run."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.config.deployment import Deployment, load_deployment
from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.common.files.resources import shipped_file
from beamsplat.common.geometry.transforms import inverse
from beamsplat.services.depth.model_files import find_model
from beamsplat.tools.evaluation.drive import open_drive
from beamsplat.tools.evaluation.evaluate import read_truth
from beamsplat.tools.report.html import write_report
from beamsplat.tools.report.map_scores import map_figures, map_from_above, previews, truth_folder
from beamsplat.tools.report.observer import Costs, Seen, run_live
from beamsplat.tools.report.scores import (
    Truth,
    compared_poses,
    depth_errors,
    pose_errors,
    rigid_offset,
    speed,
)

DEFAULT = "default"
STAND_IN = "fastdepth_nyu_fp32"


@dataclass(frozen=True)
class Configuration:
    """One row of the tables; `paper` holds the paper's own figures for it."""

    name: str
    title: str
    file: str
    model: str | None = None  # weights it needs
    paper: dict[str, float] = field(default_factory=dict)
    partner: str | None = None  # the same with the other localization

    @property
    def lidar(self) -> bool:
        return not self.name.endswith("-camera")


def _paper(position: float, yaw: float, fps: float, load: float, *depth: float) -> dict[str, float]:
    row = {"position_rmse_m": position, "yaw_rmse_rad": yaw, "fps": fps, "cpu_load_percent": load}
    return row | dict(zip(("depth_rmse_scaled_m", "depth_rmse_unscaled_m"), depth))


_UNIDEPTH, _ANYTHING = "unidepth_v2_vits", "depth_anything_v2_small"
CONFIGURATIONS = (
    Configuration("unidepth-lidar", "UniDepth + lidar", "paper/unidepth-lidar.toml", _UNIDEPTH,
                  _paper(0.0784, 0.4195, 2.176, 1024, 0.3980, 1.4600), "unidepth-camera"),
    Configuration("unidepth-camera", "UniDepth, no lidar", "paper/unidepth-camera.toml", _UNIDEPTH,
                  _paper(2.0507, 0.4142, 1.201, 1243)),
    Configuration("depth_anything-lidar", "Depth Anything + lidar", "paper/depth_anything-lidar.toml",
                  _ANYTHING, _paper(0.1753, 0.7058, 2.566, 1305, 0.5404, 1.4588), "depth_anything-camera"),
    Configuration("depth_anything-camera", "Depth Anything, no lidar", "paper/depth_anything-camera.toml",
                  _ANYTHING, _paper(3.2359, 0.7337, 1.564, 1445)),
    Configuration("monogs-lidar", "MonoGS + lidar", "paper/monogs-lidar.toml", None,
                  _paper(0.0701, 0.4514, 1.593, 1343), "monogs-camera"),
    Configuration("monogs-camera", "MonoGS, no lidar", "paper/monogs-camera.toml", None,
                  _paper(2.4102, 0.4231, 1.418, 1549)),
    Configuration(DEFAULT, "default: lidar + fused depth", "demo.toml"),
)  # fmt: skip


def chosen_configurations(names: list[str] | None) -> list[Configuration]:
    """All, or those named.

    Raises:
        UserError: there is none of that name.
    """
    known = {c.name: c for c in CONFIGURATIONS}
    for name in names or ():
        if name not in known:
            raise UserError(f"there is no configuration {name!r}; there are {', '.join(known)}")
    return [known[name] for name in names] if names else list(CONFIGURATIONS)


def prepared(
    configuration: Configuration, data: Path, out: Path, recorded: Path | None, seed: int
) -> tuple[Deployment | None, str, str]:
    """(deployment, what its depth really is, advice): None where the weights are missing and nothing can
    stand in. Another network is never shown under this one's name."""
    overrides = [f"replay.data={json.dumps(str(data))}", f"state_dir={json.dumps(str(out / 'state'))}"]
    overrides.append(f'router.listen=["tcp/127.0.0.1:{_free_port()}"]')
    depth, advice = configuration.title, ""
    if configuration.model is not None and not _installed(configuration.model):
        advice = f"weights missing: beamsplat models pull {configuration.model}"
        if recorded is not None:
            depth = f"recorded depth of {recorded.name} in the network's place"
            overrides += ['depth.source="recorded"', f"depth.options.folder={json.dumps(str(recorded))}"]
        elif _installed(STAND_IN):
            depth = "FastDepth in the network's place"
            overrides.append('depth.source="fastdepth"')
        else:
            return None, "not run", f"{advice}; FastDepth, which could stand in, is missing too ({STAND_IN})"
    deployment = load_deployment(shipped_file(configuration.file), tuple(overrides))
    nodes = {name: dict(t) for name, t in deployment.nodes.items() if name not in ("recorder", "monitor")}
    if "mapping" in nodes:
        nodes["mapping"]["seed"] = seed
    return deployment.model_copy(update={"nodes": nodes}), depth, advice


def _with(deployment: Deployment, node: str, **options: Any) -> Deployment:
    nodes = {**deployment.nodes, node: {**deployment.nodes[node], **options}}
    return deployment.model_copy(update={"nodes": nodes})


def _installed(model: str) -> bool:
    try:
        find_model(model)
    except UserError:
        return False
    return True


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def open_truth(data: Path, groundtruth: Path | None = None) -> Truth:
    """The recording with its truth, where there is one: groundtruth.txt beside the bag, or its own poses.

    Raises:
        UserError: no poses at all to compare with.
    """
    folder = truth_folder(data)
    file = groundtruth or (folder / "groundtruth.txt" if (folder / "groundtruth.txt").is_file() else None)
    bag = folder / "bag" if (folder / "bag").exists() else data
    drive = open_drive(bag, file)
    try:
        depth_files = read_truth(folder)
    except UserError:
        depth_files = {}
    return Truth(folder, drive, depth_files)


def bench_paper(
    data: Path, out: Path, *, names: list[str] | None = None, seeds: int = 1, recorded: Path | None = None,
    groundtruth: Path | None = None, seconds: float | None = None, refine_steps: int = 0,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:  # fmt: skip
    """Runs everything, writes report.json and report.html into `out`, gives the report.

    Raises:
        UserError: data, names or weights that do not fit.
    """
    configurations = chosen_configurations(names)
    truth = open_truth(data, groundtruth)
    make_folder(out)
    bag = truth.path / "bag" if (truth.path / "bag").exists() else data
    rows: list[dict[str, Any]] = []
    for configuration in configurations:
        for seed in range(seeds):
            rows.append(_one_run(configuration, bag, out, truth, recorded, seed, seconds, refine_steps, say))
            report = _report(rows, data, truth)
            write_atomically(out / "report.json", json.dumps(_figures_only(report), indent=1).encode())
            write_report(out / "report.html", report, truth)
    return _figures_only(report)


def _one_run(
    configuration: Configuration, bag: Path, out: Path, truth: Truth, recorded: Path | None, seed: int,
    seconds: float | None, refine_steps: int, say: Callable[[str], None],
) -> dict[str, Any]:  # fmt: skip
    row: dict[str, Any] = {
        "name": configuration.name, "title": configuration.title, "seed": seed, "paper": configuration.paper,
        "partner": configuration.partner, "lidar": configuration.lidar,
    }  # fmt: skip
    run_dir = out / f"{configuration.name}-{seed}"
    make_folder(run_dir)
    deployment, depth, advice = prepared(configuration, bag, run_dir, recorded, seed)
    row |= {"depth_source": depth, "advice": advice}
    if deployment is None:
        say(f"{configuration.name}: {advice}")
        return row | {"status": advice}
    if seconds is not None:
        deployment = _with(deployment, "replay", duration_s=seconds)
    if configuration.name == DEFAULT:
        deployment = _with(deployment, "mapping", final_steps=refine_steps)
    say(f"{configuration.name}: running ({depth})")
    duration_s = seconds or (truth.drive.images[-1].stamp_ns - truth.drive.images[0].stamp_ns) * 1e-9
    began = time.monotonic()
    try:
        seen, costs = run_live(
            deployment, frozenset(truth.depth_files), 4.0 * duration_s + 120.0 + 0.5 * refine_steps, say
        )
    except UserError as error:
        say(f"{configuration.name}: {error}")
        return row | {"status": str(error)}
    row |= {"status": "ok", **score(seen, costs, truth)}
    say(
        f"{row['name']}: {time.monotonic() - began:.0f} s, position {_show(row, 'position_rmse_m')} m, "
        f"fps {_show(row, 'fps')}, CPU {_show(row, 'cpu_load_percent')} %"
    )
    return row


def _show(row: dict[str, Any], name: str) -> str:
    value = row.get(name)
    return "-" if value is None else f"{value:.3g}"


def score(seen: Seen, costs: Costs, truth: Truth) -> dict[str, Any]:
    """All figures of one run, and under `pictures` what the report draws."""
    stamps, T_found, T_true = compared_poses(seen, truth)
    row = speed(seen, costs, os.cpu_count() or 1) | pose_errors(T_found, T_true) | depth_errors(seen, truth)
    T_world_map = None
    if len(T_found):
        first = next(T for _, T, status, _ in seen.poses if status == "ok")
        T_world_map = rigid_offset(T_found, T_true) @ T_found[0] @ inverse(first)
    figures, offpath = ({}, []) if T_world_map is None else map_figures(seen, truth, T_world_map)
    ends = [s.psnr_db for s in seen.statuses if np.isfinite(s.psnr_db)]
    row |= figures | {"psnr_keyframes_db": float(np.mean(ends)) if ends else None}
    row["pictures"] = {
        "stamps_ns": stamps, "found": T_found, "true": T_true, "offpath": offpath,
        "previews": previews(seen, 4),
        "estimates": seen.kept_estimates, "fused": seen.kept_fused,
        "above": None if T_world_map is None else map_from_above(seen, T_world_map, T_found[:, :2, 3]),
    }  # fmt: skip
    return row


def one_row_report(name: str, title: str, data: Path, truth: Truth, row: dict[str, Any]) -> dict[str, Any]:
    """The report of a single run that is none of the paper's."""
    whole = {
        "name": name, "title": title, "seed": 0, "paper": {}, "partner": None, "lidar": True,
        "depth_source": title, "advice": "", "status": "ok", **row,
    }  # fmt: skip
    return _report([whole], data.parent if data.name == "bag" else data, truth)


def _report(rows: list[dict[str, Any]], data: Path, truth: Truth) -> dict[str, Any]:
    return {
        "data": data.name, "cores": os.cpu_count(), "truth": truth.drive.poses_name.rsplit("/", 1)[-1],
        "configurations": rows, "pairs": pairs(rows),
    }  # fmt: skip


def pairs(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Lidar beside camera of each kind: the ratios of CPU load and of speed (the paper's 34 %)."""
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


def _figures_only(report: dict[str, Any]) -> dict[str, Any]:
    rows = [{k: v for k, v in row.items() if k != "pictures"} for row in report["configurations"]]
    return {**report, "configurations": rows}
