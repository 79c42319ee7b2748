"""Command `beamsplat bench laps`: the whole system over a long time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from beamsplat.tools.cli.options import writable

console = Console(stderr=True)
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object")]
DataOption = Annotated[
    Path | None, typer.Option(help="Bag, recording or folder to play in a loop; default: a simulated lap")
]


def _say(text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def bench_laps(
    minutes: Annotated[float, typer.Option(min=0.5, max=10_000.0, help="Length of the run")] = 60.0,
    data: DataOption = None,
    out: Annotated[
        Path, typer.Option(callback=writable, help="Folder for report.json, report.html, samples.csv")
    ] = Path("out/laps"),
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the router that is started")] = 17448,
    as_json: JsonOption = False,
) -> None:
    """Run the whole system on laps; report the growth of memory, descriptors and threads of each process.

    Exit code 1 if something grew.

    Example: beamsplat bench laps --minutes 60 --out out/laps
    """
    from beamsplat.tools.bench.laps import bench_laps as run

    report = run(data, minutes, out, f"tcp/127.0.0.1:{port}", _say)
    if as_json:
        print(json.dumps(report))
    else:
        table = Table("process", "private MB", "later", "map explains", "peak", "descriptors", "threads")
        for name, figure in report["processes"].items():
            cells = [
                f"{value:.1f}"
                for value in (*figure["private_mb"], figure["explained_mb"], figure["peak_private_mb"])
            ]
            table.add_row(
                name, *cells, *("{} -> {}".format(*figure[key]) for key in ("descriptors", "threads"))
            )
        Console().print(table)
        print(f"{out / 'report.html'}\n{out / 'report.json'}")
    for finding in report["findings"]:
        _say(finding)
    if report["findings"]:
        raise typer.Exit(1)
