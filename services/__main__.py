"""The command `beamsplat`."""

from __future__ import annotations

import sys

import typer
from rich.console import Console
from rich.markup import escape

from common.errors import UserError
from services import demo, doctor, keys_cli, swap_cli, system_cli, warm
from services.bench import cli as bench_cli
from services.depth import models_cli
from services.evaluation import calibrate_cli
from services.evaluation import cli as depth_cli
from services.evaluation.relocalize_cli import eval_relocalize
from services.localization import cli as localization_cli
from services.mapping import cli as mapping_cli
from services.mapping.formats import cli as formats_cli
from services.mapping.session import cli as session_cli
from services.replay import cli as replay_cli
from services.setup import cli as setup_cli
from services.simulator import cli as simulator_cli

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
for command in (
    demo.demo, system_cli.run, system_cli.check, system_cli.serve, system_cli.offline, system_cli.record,
    system_cli.top, system_cli.topics, system_cli.graph, system_cli.router_config,
):  # fmt: skip
    app.command(rich_help_panel=_SYSTEM)(command)
app.command(rich_help_panel=_SYSTEM)(swap_cli.swap)
app.add_typer(swap_cli.app, name="params", rich_help_panel=_SYSTEM)
for command in (simulator_cli.simulate, replay_cli.info, replay_cli.rig):
    app.command(rich_help_panel=_DATA)(command)
app.add_typer(calibrate_cli.app, name="calibrate", rich_help_panel=_DATA)
for command in (localization_cli.slam, depth_cli.depth, formats_cli.export, formats_cli.render):
    app.command(rich_help_panel=_RESULTS)(command)

app.add_typer(session_cli.app, name="session", rich_help_panel=_RESULTS)

evaluate = typer.Typer(no_args_is_help=True, help="Errors against truth.")
evaluate.command("slam")(localization_cli.eval_slam)
evaluate.command("relocalize")(eval_relocalize)
evaluate.command("depth")(depth_cli.eval_depth)
app.add_typer(evaluate, name="eval", rich_help_panel=_RESULTS)

for command in (setup_cli.setup, doctor.doctor, warm.warm):
    app.command(rich_help_panel=_MACHINE)(command)
app.add_typer(models_cli.app, name="models", rich_help_panel=_MACHINE)
app.add_typer(keys_cli.app, name="keys", rich_help_panel=_MACHINE)
bench_cli.app.command("depth")(depth_cli.bench_depth)
bench_cli.app.command("raster")(mapping_cli.bench_raster)
bench_cli.app.command("map")(mapping_cli.bench_map)
app.add_typer(bench_cli.app, name="bench", rich_help_panel=_MACHINE)


def main() -> None:
    """Entry point: bad input is one sentence and exit code 2, not a traceback."""
    try:
        app()
    except UserError as error:
        Console(stderr=True).print(f"[red]error:[/] {escape(str(error))}", soft_wrap=True, highlight=False)
        sys.exit(2)


if __name__ == "__main__":
    main()
