"""`beamsplat train aggregator`: homes, training, export and evaluation; resumed where it was interrupted."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.tools.training import generate
from beamsplat.tools.training.generate import HomeTask, generate_homes, home_tasks
from beamsplat.tools.training.sample_files import samples_in

WEIGHTS, SETTINGS, REPORT, CHECKPOINT = "aggregator.onnx", "settings.json", "report.json", "checkpoint.pt"
MAX_BYTES = 3_000_000  # of the weights file, which is to be part of the package
Stage = Callable[[str, int, int], None]  # name of the stage, finished parts, all parts


@dataclass(frozen=True)
class AggregatorTraining:
    """Settings of a training; with the same settings it yields the same weights on the same machine."""

    homes: int
    heldout_homes: int
    seed: int
    samples: int  # of each home and carrier
    passes: float  # over all training samples
    batch: int = 4
    threads: int = 2
    source: str = ""  # depth source whose estimates are an input, beside those of `stixel`
    source_options: dict[str, Any] = field(default_factory=dict)


def train_aggregator(
    training: AggregatorTraining, out: Path, *, jobs: int, device: str, stage: Stage
) -> dict[str, Any]:
    """Generate homes, train, export `aggregator.onnx`, and evaluate on held-out homes; return the report.

    What exists in the folder `out` from an earlier call is used: finished homes, and the checkpoint of the
    same training. The report is also written to `report.json`.

    Args:
        training: all settings.
        out: folder; it is created.
        jobs: processes that generate homes.
        device: "auto", "cpu" or "cuda".
        stage: is called with the progress of each stage.

    Raises:
        UserError: the folder has samples of other settings, or a home, a sample or the device cannot be used.
    """
    make_folder(out)
    _check_data(training, out)
    began = time.monotonic()
    records = {kind: _generate(training, out, kind, jobs, stage) for kind in ("train", "heldout")}
    generated_s = time.monotonic() - began
    trained = _train(training, out, device, stage)
    report = {
        "settings": asdict(training), "homes": records, "generation_wall_s": generated_s, **trained,
        "heldout": _evaluate(out, stage),
    }  # fmt: skip
    write_atomically(out / REPORT, (json.dumps(report, indent=1) + "\n").encode())
    return report


def _check_data(training: AggregatorTraining, out: Path) -> None:
    """Write the settings that determine the samples, or compare them with those of an earlier call."""
    now = {
        "format": generate.FORMAT, "seed": training.seed, "samples": training.samples,
        "source": training.source, "source_options": training.source_options,
    }  # fmt: skip
    path = out / SETTINGS
    if not path.is_file():
        write_atomically(path, (json.dumps(now, indent=1) + "\n").encode())
        return
    try:
        before = json.loads(path.read_text())
        different = [name for name in now if before.get(name) != now[name]]
    except (OSError, ValueError, AttributeError) as error:
        raise UserError(f"{path}: cannot be read ({error}): choose another --out") from error
    if different:
        name = different[0]
        raise UserError(
            f"{path}: the samples in this folder were made with {name} = {before.get(name)!r}, not "
            f"{now[name]!r}: choose another --out, or the same value"
        )


def _generate(training: AggregatorTraining, out: Path, kind: str, jobs: int, stage: Stage) -> dict[str, Any]:
    count = training.homes if kind == "train" else training.heldout_homes
    tasks: list[HomeTask] = home_tasks(
        out, kind, count, training.seed, training.samples, training.source, training.source_options
    )
    name = "generating homes" if kind == "train" else "generating held-out homes"
    records = generate_homes(tasks, jobs, lambda done, total: stage(name, done, total))
    keys = ("robot", "hand", "people", "bytes", "cpu_s")
    return {"count": len(records), **{key: sum(record[key] for record in records) for key in keys}}


def _train(training: AggregatorTraining, out: Path, device: str, stage: Stage) -> dict[str, Any]:
    from beamsplat.tools.training.onnx_file import onnx_bytes
    from beamsplat.tools.training.optimisation import OptimisationSettings, optimise

    device = _chosen_device(device)
    homes = [out / "train" / f"home_{k:04d}" for k in range(training.homes)]
    robot, hand = (
        [path for home in homes for path in sorted(home.glob(f"{carrier}_*"))]
        for carrier in ("robot", "hand")
    )
    steps = max(1, round(training.passes * (len(robot) + len(hand)) / training.batch))
    settings = OptimisationSettings(training.seed, steps, training.batch, training.threads)
    began, cpu_began, first = time.monotonic(), time.process_time(), steps

    def progress(done: int, total: int, loss: float) -> None:
        nonlocal first
        first = min(first, done)
        stage("training" if loss != loss else f"training (cross entropy {loss:.3f})", done, total)

    network = optimise(robot, hand, settings, out / CHECKPOINT, device, progress)
    wall_s, cpu_s = time.monotonic() - began, time.process_time() - cpu_began
    data = onnx_bytes(
        network, {"seed": str(training.seed), "steps": str(steps), "homes": str(training.homes)}
    )
    if len(data) > MAX_BYTES:
        raise UserError(f"the weights have {len(data)} bytes, at most {MAX_BYTES} are allowed")
    write_atomically(out / WEIGHTS, data)
    return {
        "device": device, "steps": steps, "steps_of_this_call": steps - first, "training_wall_s": wall_s,
        "training_cpu_s": cpu_s, "parameters": sum(p.numel() for p in network.parameters()),
        "weights_bytes": len(data), "weights_sha256": hashlib.sha256(data).hexdigest(),
    }  # fmt: skip


def _chosen_device(device: str) -> str:
    import torch

    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise UserError("--device cuda: PyTorch finds no CUDA device here; use --device cpu")
    return ("cuda" if available else "cpu") if device == "auto" else device


def _evaluate(out: Path, stage: Stage) -> dict[str, Any]:
    from beamsplat.tools.training.held_out import evaluate_held_out, network_cpu_ms

    folder = out / "heldout"
    if not (samples_in(folder, "robot") or samples_in(folder, "hand")):
        return {}
    report = evaluate_held_out(
        out / WEIGHTS, folder, lambda done, total: stage("evaluating held-out homes", done, total)
    )
    median_ms, least_ms = network_cpu_ms(out / WEIGHTS)
    return {**report, "network_cpu_ms": median_ms, "network_least_cpu_ms": least_ms}
