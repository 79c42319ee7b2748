"""Command `beamsplat bench geometry`: picture and geometry of a map over the weight of depth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from beamsplat.tools.cli.depth import options_of


def bench_geometry(
    data: Annotated[Path, typer.Argument(help="Folder with bag/, groundtruth.txt and extra_views/")],
    weight: Annotated[
        list[float] | None,
        typer.Option(help="Weight of depth in the loss; repeatable. Default: 0, 0.05, 0.15, 0.5, 1.5"),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=1.0, help="Map only the first seconds of the drive")
    ] = None,
    prior: Annotated[
        str, typer.Option(help="Depth of the keyframes: field (fused), stixel or truth")
    ] = "field",
    source: Annotated[str, typer.Option(help="Depth source that fusion uses (with field)")] = "stixel",
    without_beams: Annotated[
        str, typer.Option(help="Metric depth network of one more map, without lidar; for example fastdepth")
    ] = "",
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="OPTION=VALUE", help="Option of that network; repeatable"),
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of the rasterizer")] = 2,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the mapper")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object")] = False,
) -> None:
    """Build the same map with several weights of depth, and one without beams; compare picture and geometry.

    Each map costs about as much CPU time as `bench map` without refinement. Views off the path are scored if
    the mapped part of the drive comes near to them.

    Examples:

        beamsplat bench geometry drive --seconds 25

        beamsplat bench geometry drive --without-beams fastdepth --weight 0 --weight 0.15
    """
    import cv2

    from beamsplat.services.mapping.profiles import settings_for
    from beamsplat.tools.bench.geometry import WEIGHTS, GeometryBenchSettings, run_geometry

    cv2.setNumThreads(1)
    console = Console(stderr=True)
    bench = GeometryBenchSettings(
        weights=tuple(weight) if weight else WEIGHTS, seconds=seconds, prior=prior, source=source,
        without_beams=without_beams, source_options=tuple(options_of(set_).items()),
        mapper=settings_for("cpu"), threads=threads, seed=seed,
    )  # fmt: skip
    result = run_geometry(data, bench, console.print)
    if as_json:
        print(json.dumps(result))
        return
    columns = {
        "PSNR off the path (dB)": "psnr_offpath_db", "SSIM": "ssim_offpath",
        "depth L1 off the path (m)": "depth_l1_offpath_m", "PSNR held out (dB)": "psnr_heldout_db",
    }  # fmt: skip
    table = Table(
        "map", *columns, "Gaussians", "CPU s",
        title=f"{result['seconds']:.0f} s, {result['offpath_views']} views off the path",
    )  # fmt: skip
    for row in result["cases"]:
        figures = ("-" if row[key] is None else f"{row[key]:.3f}" for key in columns.values())
        table.add_row(row["case"], *figures, str(row["gaussians"]), f"{row['cpu_s']:.0f}")
    Console().print(table)
