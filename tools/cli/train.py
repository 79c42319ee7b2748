"""Command `beamsplat train`: trains the networks of BeamSplat on simulated homes."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from beamsplat.common.errors import UserError
from beamsplat.tools.cli.depth import options_of
from beamsplat.tools.cli.options import writable

app = typer.Typer(no_args_is_help=True, help="Train a network on simulated homes.")
console = Console(stderr=True)


@app.callback()
def _train() -> None:
    """Keep `aggregator` as a command of the group, although it is the only one."""


@app.command()
def aggregator(
    out: Annotated[
        Path, typer.Option(callback=writable, help="Folder for samples, checkpoint, weights and report.")
    ],
    homes: Annotated[int, typer.Option(min=1, max=100_000, help="Number of simulated homes.")] = 100,
    heldout_homes: Annotated[
        int, typer.Option(min=0, max=10_000, help="Further homes, only to evaluate on.")
    ] = 6,
    seed: Annotated[int, typer.Option(min=0, max=1000, help="Seed of homes, samples and training.")] = 0,
    samples: Annotated[
        int, typer.Option(min=1, max=500, help="Images of each home on a robot, and as many hand-held.")
    ] = 40,
    passes: Annotated[float, typer.Option(min=0.001, help="How often each sample is used.")] = 6.0,
    batch: Annotated[int, typer.Option(min=1, max=256, help="Samples per step.")] = 4,
    source: Annotated[
        str, typer.Option(help="Depth source that is an input, for example fastdepth; default: none.")
    ] = "",
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="OPTION=VALUE", help="Option of that depth source; repeatable"),
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    threads: Annotated[int, typer.Option(min=1, help="Threads of PyTorch on the CPU.")] = 2,
    jobs: Annotated[int, typer.Option(min=1, help="Processes that generate homes.")] = os.cpu_count() or 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as one JSON object.")] = False,
) -> None:
    """Train the learned aggregation of depth fusion, and evaluate it on held-out homes.

    Writes aggregator.onnx (for fusion.aggregation_weights) and report.json. The homes have clutter near the
    camera, white walls, windows and people; the images motion blur, rolling shutter, changes of exposure and
    white balance. An interrupted command continues when it is called again. On the CPU, the same options
    give the same weights on the same machine. More --homes later use those that exist.

    Examples:

    beamsplat train aggregator --out out/aggregator --homes 100

    beamsplat train aggregator --out out/tiny --homes 1 --heldout-homes 1 --samples 4 --passes 1

    beamsplat train aggregator --out out/fast --homes 200 --source fastdepth --device cuda
    """
    from beamsplat.tools.training.aggregator import WEIGHTS, AggregatorTraining, train_aggregator

    if device not in ("auto", "cpu", "cuda"):
        raise UserError(f"--device {device}: expected auto, cpu or cuda")
    training = AggregatorTraining(
        homes=homes, heldout_homes=heldout_homes, seed=seed, samples=samples, passes=passes, batch=batch,
        threads=threads, source=source, source_options=options_of(set_),
    )  # fmt: skip
    try:
        with _StageBar() as bar:
            report = train_aggregator(training, out, jobs=jobs, device=device, stage=bar.show)
    except KeyboardInterrupt as error:
        console.print(f"stopped; the same command continues with what is in {out}")
        raise typer.Exit(130) from error
    if as_json:
        print(json.dumps(report))
        return
    _print_summary(report)
    print(out / WEIGHTS)


def _print_summary(report: dict[str, Any]) -> None:
    made = report["homes"]["train"]
    print(
        f"{made['count']} homes, {made['robot']} samples of robots and {made['hand']} hand-held, "
        f"{made['cpu_s'] / max(made['count'], 1):.0f} CPU s and "
        f"{made['bytes'] / max(made['count'], 1) / 1e6:.0f} MB per home"
    )
    print(
        f"{report['steps']} steps on {report['device']}, {report['parameters']} parameters, "
        f"{report['weights_bytes'] / 1e6:.2f} MB"
    )
    heldout = report["heldout"]
    if not heldout:
        return
    median, least = heldout["network_cpu_ms"], heldout["network_least_cpu_ms"]
    print(f"network: {median:.1f} CPU ms per keyframe (least {least:.1f}), one thread")
    table = Table(
        title="held-out homes: change from sgm to learned, with 95 % intervals", title_justify="left"
    )
    for column in ("carrier", "figure", "sgm", "learned", "change"):
        table.add_column(column)
    for carrier in ("robot", "hand"):
        for name in ("absrel", "l1_m", "rmse_m", "within_5cm"):
            entry = heldout[carrier]["comparison"][name]
            bounds = entry["change_interval"]
            interval = "" if bounds is None else f" ({bounds[0]:.3f} to {bounds[1]:.3f})"
            values = (f"{entry[key]:.4f}" for key in ("first", "second"))
            table.add_row(carrier, name, *values, f"{entry['change']:.3f}{interval}")
    Console().print(table)


class _StageBar:
    """Progress display on standard error, one line per stage."""

    def __init__(self) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
            TimeRemainingColumn(), console=console,
        )  # fmt: skip
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> _StageBar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, stage: str, done: int, total: int) -> None:
        """Show the progress of a stage; what stands in parentheses may change meanwhile."""
        name = stage.partition(" (")[0]
        if name not in self._tasks:
            self._tasks[name] = self._progress.add_task(stage, total=total)
        self._progress.update(self._tasks[name], description=stage, completed=done, total=total)
