"""`beamsplat demo`: the whole system on a simulated drive, or on a recording of your own."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from common.config import load_deployment
from common.errors import UserError

DEPLOYMENT = Path(__file__).resolve().parents[1] / "deploy" / "demo.toml"
console = Console(stderr=True)


def demo(
    out: Annotated[Path, typer.Option(help="Folder for everything the demo makes")] = Path("out/demo"),
    data: Annotated[Path | None, typer.Option(help="Your own bag, recording or folder")] = None,
    seconds: Annotated[float, typer.Option(help="Length of the simulated drive")] = 30.0,
    rate: Annotated[float, typer.Option(help="Times real time")] = 1.0,
    view: Annotated[str, typer.Option(help="none, spawn (a window) or serve (a web viewer)")] = "none",
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="NODE.OPTION=VALUE", help="Override an option")
    ] = None,
) -> None:
    """Simulates a drive through a furnished home, runs the system on it live, watches and records it.

    Examples:

        beamsplat demo

        beamsplat demo --data drive/bag --view spawn
    """
    from services.system_cli import run_checked

    out.mkdir(parents=True, exist_ok=True)
    source = data if data is not None else _simulated(out, seconds)
    shutil.rmtree(out / "recording", ignore_errors=True)
    shutil.rmtree(out / "map", ignore_errors=True)
    (out / "demo.rrd").unlink(missing_ok=True)
    overrides = (
        f"replay.data={json.dumps(str(source))}",
        f"recorder.out={json.dumps(str(out / 'recording'))}",
        f"monitor.save={json.dumps(str(out / 'demo.rrd'))}",
        f"monitor.view={json.dumps(view)}",
        f"mapping.save={json.dumps(str(out / 'map'))}",
        f"rate={rate}",
        *(set_ or ()),
    )
    run_checked(load_deployment(DEPLOYMENT, overrides))
    _report(out, source)


def _simulated(out: Path, seconds: float) -> Path:
    """The bag of a drive simulated into `out`, made anew only if its length differs."""
    from services.simulator.cli import simulate

    folder = out / f"simulated-{seconds:g}s"
    if not folder.exists():  # the simulator leaves a whole folder or none
        simulate(folder, seconds=seconds)
    return folder / "bag"


def _report(out: Path, source: Path) -> None:
    table = Table("file", "what it is", show_header=False, pad_edge=False)
    rows = [
        (source, "the drive: camera, lidar, wheels"),
        (out / "recording", "what went over the bus; opens in Foxglove and with `ros2 bag`"),
        (out / "demo.rrd", "what the monitor saw; open it with `rerun FILE`"),
    ]
    if (out / "map").exists():  # data without a camera give none
        rows.append((out / "map" / "map.ply", "the map: opens in viewers of 3D Gaussian splats"))
    for path, what in rows:
        if not path.exists():
            raise UserError(f"{path} was not written: the node's log in the state folder says why")
        table.add_row(str(path), what)
    Console().print(table)
