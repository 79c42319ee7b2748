"""`beamsplat bench ...`: the figures of this machine, each beside a baseline of the same run."""

from __future__ import annotations

import json
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

app = typer.Typer(no_args_is_help=True, help="Measure this machine; every figure has a baseline beside it.")
console = Console(stderr=True)
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object")]


@app.command()
def bus(
    seconds: Annotated[float, typer.Option(help="Length of each part")] = 10.0,
    megabytes: Annotated[float, typer.Option(help="Size of a picture")] = 1.0,
    port: Annotated[int, typer.Option(help="Port of the router this starts")] = 17447,
    as_json: JsonOption = False,
) -> None:
    """Latency of pictures through the local router beside plain Zenoh; what a slow subscriber costs.

    Example: beamsplat bench bus --seconds 20 --json
    """
    from services.bench.bus import bench_bus

    result = bench_bus(seconds, int(megabytes * 1e6), f"tcp/127.0.0.1:{port}", console.print)
    if as_json:
        print(json.dumps(result))
        return
    table = Table("figure", "value")
    for name, value in result.items():
        table.add_row(name, f"{value:.2f}" if isinstance(value, float) else str(value))
    Console().print(table)
