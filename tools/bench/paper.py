"""`bench paper`: the paper's six configurations and our default one, each in a live run."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from beamsplat.common.config.deployment import Deployment, load_deployment
from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.common.files.resources import shipped_file
from beamsplat.services.depth.model_files import find_model
from beamsplat.tools.report.html import write_report
from beamsplat.tools.report.observer import run_live
from beamsplat.tools.report.run_report import open_truth, report_of_runs, score_run
from beamsplat.tools.report.scores import GroundTruth

DEFAULT = "default"
SUBSTITUTE_MODEL = "fastdepth_nyu_fp32"  # replaces networks whose weights are missing


@dataclass(frozen=True)
class Configuration:
    """One configuration, a row of the tables; `paper` contains the published results by name."""

    name: str
    title: str
    file: str
    model: str | None = None  # required weights
    paper: dict[str, float] = field(default_factory=dict)
    partner: str | None = None  # the configuration with the same depth and camera localization

    @property
    def lidar(self) -> bool:
        """Whether localization uses the lidar."""
        return not self.name.endswith("-camera")


def _paper_figures(position: float, yaw: float, fps: float, load: float, *depth: float) -> dict[str, float]:
    row = {"position_rmse_m": position, "yaw_rmse_rad": yaw, "fps": fps, "cpu_load_percent": load}
    return row | dict(zip(("depth_rmse_scaled_m", "depth_rmse_unscaled_m"), depth))


_UNIDEPTH, _ANYTHING = "unidepth_v2_vits", "depth_anything_v2_small"
CONFIGURATIONS = (
    Configuration("unidepth-lidar", "UniDepth + lidar", "paper/unidepth-lidar.toml", _UNIDEPTH,
                  _paper_figures(0.0784, 0.4195, 2.176, 1024, 0.3980, 1.4600), "unidepth-camera"),
    Configuration("unidepth-camera", "UniDepth, no lidar", "paper/unidepth-camera.toml", _UNIDEPTH,
                  _paper_figures(2.0507, 0.4142, 1.201, 1243)),
    Configuration("depth_anything-lidar", "Depth Anything + lidar", "paper/depth_anything-lidar.toml",
                  _ANYTHING, _paper_figures(0.1753, 0.7058, 2.566, 1305, 0.5404, 1.4588),
                  "depth_anything-camera"),
    Configuration("depth_anything-camera", "Depth Anything, no lidar", "paper/depth_anything-camera.toml",
                  _ANYTHING, _paper_figures(3.2359, 0.7337, 1.564, 1445)),
    Configuration("monogs-lidar", "MonoGS + lidar", "paper/monogs-lidar.toml", None,
                  _paper_figures(0.0701, 0.4514, 1.593, 1343), "monogs-camera"),
    Configuration("monogs-camera", "MonoGS, no lidar", "paper/monogs-camera.toml", None,
                  _paper_figures(2.4102, 0.4231, 1.418, 1549)),
    Configuration(DEFAULT, "default: lidar + fused depth", "demo.toml"),
)  # fmt: skip


def select_configurations(names: list[str] | None) -> list[Configuration]:
    """Return the configurations called `names`, in this order; all configurations if there are no names.

    Raises:
        UserError: no configuration has one of the names.
    """
    known = {c.name: c for c in CONFIGURATIONS}
    for name in names or ():
        if name not in known:
            raise UserError(f"unknown configuration {name!r}; known are {', '.join(known)}")
    return [known[name] for name in names] if names else list(CONFIGURATIONS)


def prepare_deployment(
    configuration: Configuration, data: Path, out: Path, recorded: Path | None, seed: int
) -> tuple[Deployment | None, str, str]:
    """Return the deployment of a configuration, a description of its depth source, and advice for the user.

    If the weights of the depth network are missing, recorded depth or FastDepth replaces the network. The
    description then names the replacement, and the advice is the command that installs the weights. If no
    replacement is installed either, the deployment is None.

    Args:
        data: the bag to play.
        out: folder of the run; its folder `state` receives logs and state.
        recorded: folder of recorded depth maps by stamp; None if there are none.
        seed: seed of the mapper.
    """
    overrides = [f"replay.data={json.dumps(str(data))}", f"state_dir={json.dumps(str(out / 'state'))}"]
    overrides.append(f'router.listen=["tcp/127.0.0.1:{_free_port()}"]')
    depth, advice = configuration.title, ""
    if configuration.model is not None and not _installed(configuration.model):
        advice = f"weights missing: beamsplat models pull {configuration.model}"
        if recorded is not None:
            depth = f"recorded depth of {recorded.name} instead of the network"
            overrides += ['depth.source="recorded"', f"depth.options.folder={json.dumps(str(recorded))}"]
        elif _installed(SUBSTITUTE_MODEL):
            depth = "FastDepth instead of the network"
            overrides.append('depth.source="fastdepth"')
        else:
            return (
                None,
                "not run",
                f"{advice}; the substitute {SUBSTITUTE_MODEL} is missing too",
            )
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


def bench_paper(
    data: Path, out: Path, *, names: list[str] | None = None, seeds: int = 1, recorded: Path | None = None,
    groundtruth: Path | None = None, seconds: float | None = None, refine_steps: int = 0,
    log: Callable[[str], None] = print,
) -> dict[str, Any]:  # fmt: skip
    """Run configurations live in real time, write report.json and report.html into `out`, return the report.

    Args:
        data: folder with bag/ and its ground truth, or a bag that contains poses.
        names: configurations to run; None runs all.
        seeds: runs of each configuration.
        recorded: folder of depth maps by stamp that replaces networks with missing weights.
        groundtruth: TUM file of the true body poses; None searches beside the bag and in it.
        seconds: length in s of the part of the recording that is played, from its start; None plays all.
        refine_steps: refinement steps of the default configuration after the drive.
        log: receives progress messages.

    Raises:
        UserError: data or names are invalid.
    """
    configurations = select_configurations(names)
    truth = open_truth(data, groundtruth)
    make_folder(out)
    bag = truth.path / "bag" if (truth.path / "bag").exists() else data
    rows: list[dict[str, Any]] = []
    for configuration in configurations:
        for seed in range(seeds):
            rows.append(_one_run(configuration, bag, out, truth, recorded, seed, seconds, refine_steps, log))
            report = report_of_runs(rows, data, truth)
            write_atomically(out / "report.json", json.dumps(_figures_only(report), indent=1).encode())
            write_report(out / "report.html", report, truth)
    return _figures_only(report)


def _one_run(
    configuration: Configuration, bag: Path, out: Path, truth: GroundTruth, recorded: Path | None, seed: int,
    seconds: float | None, refine_steps: int, log: Callable[[str], None],
) -> dict[str, Any]:  # fmt: skip
    row: dict[str, Any] = {
        "name": configuration.name, "title": configuration.title, "seed": seed, "paper": configuration.paper,
        "partner": configuration.partner, "lidar": configuration.lidar,
    }  # fmt: skip
    run_dir = out / f"{configuration.name}-{seed}"
    make_folder(run_dir)
    deployment, depth, advice = prepare_deployment(configuration, bag, run_dir, recorded, seed)
    row |= {"depth_source": depth, "advice": advice}
    if deployment is None:
        log(f"{configuration.name}: {advice}")
        return row | {"status": advice}
    if seconds is not None:
        deployment = _with(deployment, "replay", duration_s=seconds)
    if configuration.name == DEFAULT:
        deployment = _with(deployment, "mapping", final_steps=refine_steps)
    log(f"{configuration.name}: running ({depth})")
    duration_s = seconds or (truth.drive.images[-1].stamp_ns - truth.drive.images[0].stamp_ns) * 1e-9
    began = time.monotonic()
    try:
        record, costs = run_live(
            deployment, frozenset(truth.depth_files), 4.0 * duration_s + 120.0 + 0.5 * refine_steps, log
        )
    except UserError as error:
        log(f"{configuration.name}: {error}")
        return row | {"status": str(error)}
    row |= {"status": "ok", **score_run(record, costs, truth)}
    log(
        f"{row['name']}: {time.monotonic() - began:.0f} s, position {_format(row, 'position_rmse_m')} m, "
        f"fps {_format(row, 'fps')}, CPU {_format(row, 'cpu_load_percent')} %"
    )
    return row


def _format(row: dict[str, Any], name: str) -> str:
    value = row.get(name)
    return "-" if value is None else f"{value:.3g}"


def _figures_only(report: dict[str, Any]) -> dict[str, Any]:
    rows = [{k: v for k, v in row.items() if k != "plots"} for row in report["configurations"]]
    return {**report, "configurations": rows}
