"""Commands `beamsplat models list | pull | check`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn
from rich.table import Table

app = typer.Typer(no_args_is_help=True, help="Depth networks: list them, download one, check a file.")


@app.command("list")
def list_models(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """List all known models: licence, whether the file is installed, how to obtain it.

    Example: beamsplat models list
    """
    from beamsplat.services.depth.models import installed_path, read_model_table

    rows = read_model_table()
    if as_json:
        print(
            json.dumps({n: {**r.model_dump(), "file": str(installed_path(n) or "")} for n, r in rows.items()})
        )
        return
    table = Table()
    for title in ("name", "source", "licence", "MB", "installed", "how to get it"):
        table.add_column(title, overflow="fold")
    for name, row in rows.items():
        where = installed_path(name)
        way = f"beamsplat models pull {name}" if row.url else row.how
        licence = row.licence if row.commercial else f"{row.licence} (not commercial)"
        size = "?" if row.size_mb is None else f"{row.size_mb:g}"
        table.add_row(name, row.source, licence, size, str(where) if where else "-", way)
    Console().print(table)


@app.command("pull")
def pull_model(
    name: Annotated[str, typer.Argument(help="A name or a source from `beamsplat models list`.")],
    yes: Annotated[
        bool, typer.Option("--yes", help="Accept the licence and an unverified file without asking.")
    ] = False,
) -> None:
    """Download a model into the first folder of BEAMSPLAT_MODELS, or the user's data folder.

    An interrupted download is resumed; the digest is checked before the file is installed. A network that may
    not be used commercially is downloaded only after you agree.

    Examples:

        beamsplat models pull moge

        beamsplat models pull depth_anything_v2_small

        beamsplat models pull --yes unidepth
    """
    from beamsplat.services.depth.models import model_name, pull, read_model_table

    table = read_model_table()
    name = model_name(name, table)
    row = table[name]
    bar = Progress(
        TextColumn(name), BarColumn(), DownloadColumn(), TransferSpeedColumn(), console=Console(stderr=True)
    )
    task = bar.add_task("", total=None)

    def agree(question: str) -> bool:
        bar.stop()
        return yes or typer.confirm(question, err=True)

    def progress(done: int, total: int | None) -> None:
        bar.start()
        bar.update(task, completed=done, total=total)

    try:
        print(pull(name, row, agree, progress))
    finally:
        bar.stop()
    if row.note:
        Console(stderr=True).print(row.note, highlight=False)


@app.command("check")
def check_model(
    file: Annotated[Path, typer.Argument(help="A file, or the name of an installed model.")],
) -> None:
    """Show digest, inputs, outputs and execution providers of a model file.

    Example: beamsplat models check my.onnx
    """
    from beamsplat.services.depth.models import describe_model_file, model_name, read_model_table

    table = read_model_table()
    sources = {row.source for row in table.values()}
    if str(file) in sources and not file.exists():
        file = Path(model_name(str(file), table))
    print(json.dumps(describe_model_file(file, table), indent=2))
