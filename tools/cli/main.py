"""The command `beamsplat`."""

from __future__ import annotations

import importlib.metadata
import platform
import sys
from collections.abc import Callable
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from beamsplat.common.errors import NothingUseful, UserError
from beamsplat.common.optional_packages import missing_packages_explained
from beamsplat.tools.cli import bench as bench_cli
from beamsplat.tools.cli import bench_endurance as endurance_cli
from beamsplat.tools.cli import bench_geometry as geometry_cli
from beamsplat.tools.cli import bench_mapping as mapping_cli
from beamsplat.tools.cli import bug_report, demo, doctor, warm
from beamsplat.tools.cli import calibrate as calibrate_cli
from beamsplat.tools.cli import compare as compare_cli
from beamsplat.tools.cli import depth as depth_cli
from beamsplat.tools.cli import export as formats_cli
from beamsplat.tools.cli import info as replay_cli
from beamsplat.tools.cli import keys as keys_cli
from beamsplat.tools.cli import models as models_cli
from beamsplat.tools.cli import session as session_cli
from beamsplat.tools.cli import session_edit as edit_cli
from beamsplat.tools.cli import setup as setup_cli
from beamsplat.tools.cli import simulate as simulator_cli
from beamsplat.tools.cli import slam as localization_cli
from beamsplat.tools.cli import swap as swap_cli
from beamsplat.tools.cli import system as system_cli
from beamsplat.tools.cli import train as train_cli
from beamsplat.tools.cli import view as view_cli
from beamsplat.tools.cli import watch as watch_cli
from beamsplat.tools.cli.relocalize import eval_relocalize

app = typer.Typer(
    name="beamsplat",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="A live, metric, photorealistic 3D Gaussian map from one camera and one 2D lidar.",
)
_SYSTEM = "Run a system"
_DATA = "Recordings and calibration"
_RESULTS = "Maps and figures"
_MACHINE = "This machine"
command: Callable[..., None]
for command in (
    demo.demo, system_cli.run, system_cli.check, system_cli.serve, system_cli.offline, system_cli.record,
    watch_cli.top, watch_cli.topics, watch_cli.graph, system_cli.router_config,
):  # fmt: skip
    app.command(rich_help_panel=_SYSTEM)(command)
app.command(rich_help_panel=_SYSTEM)(swap_cli.swap)
app.add_typer(swap_cli.app, name="params", rich_help_panel=_SYSTEM)
for command in (simulator_cli.simulate, replay_cli.info, replay_cli.rig):
    app.command(rich_help_panel=_DATA)(command)
app.add_typer(calibrate_cli.app, name="calibrate", rich_help_panel=_DATA)
for command in (
    view_cli.view, localization_cli.slam, depth_cli.depth, formats_cli.export, formats_cli.render,
    compare_cli.compare,
):  # fmt: skip
    app.command(rich_help_panel=_RESULTS)(command)

for command in (edit_cli.edit, edit_cli.undo):
    session_cli.app.command()(command)
app.add_typer(session_cli.app, name="session", rich_help_panel=_RESULTS)

evaluate = typer.Typer(no_args_is_help=True, help="Errors against truth.")
evaluate.command("slam")(localization_cli.eval_slam)
evaluate.command("relocalize")(eval_relocalize)
evaluate.command("depth")(depth_cli.eval_depth)
evaluate.command("compare")(compare_cli.eval_compare)
app.add_typer(evaluate, name="eval", rich_help_panel=_RESULTS)

for command in (setup_cli.setup, doctor.doctor, bug_report.bug_report, warm.warm):
    app.command(rich_help_panel=_MACHINE)(command)
app.add_typer(models_cli.app, name="models", rich_help_panel=_MACHINE)
app.add_typer(train_cli.app, name="train", rich_help_panel=_MACHINE)
app.add_typer(keys_cli.app, name="keys", rich_help_panel=_MACHINE)
bench_cli.app.command("depth")(depth_cli.bench_depth)
bench_cli.app.command("raster")(mapping_cli.bench_raster)
bench_cli.app.command("gpu")(mapping_cli.bench_gpu)
bench_cli.app.command("map")(mapping_cli.bench_map)
bench_cli.app.command("geometry")(geometry_cli.bench_geometry)
bench_cli.app.command("laps")(endurance_cli.bench_laps)
bench_cli.app.command("faults")(endurance_cli.bench_faults)
app.add_typer(bench_cli.app, name="bench", rich_help_panel=_MACHINE)


def version_line() -> str:
    """Return the versions of this package and of Python, and the platform, in one line."""
    return (
        f"beamsplat {importlib.metadata.version('beamsplat')}, Python {platform.python_version()}, "
        f"{platform.platform()}"
    )


def _print_version(wanted: bool) -> None:
    if wanted:
        print(version_line())
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print version, Python and platform."
        ),
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run the command line; a UserError is printed as one sentence, exit code 2 (NothingUseful: 3)."""
    try:
        with missing_packages_explained(f"beamsplat {' '.join(sys.argv[1:2])}".strip()):
            app()
    except UserError as error:
        Console(stderr=True).print(f"[red]error:[/] {escape(str(error))}", soft_wrap=True, highlight=False)
        sys.exit(3 if isinstance(error, NothingUseful) else 2)


if __name__ == "__main__":
    main()
