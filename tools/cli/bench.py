"""Commands `beamsplat bench`: bus, slam, sites, uncertainties, paper, sensitivity."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from beamsplat.tools.cli.options import writable

app = typer.Typer(
    no_args_is_help=True, help="Measure this machine; every figure has a baseline of the same run."
)
console = Console(stderr=True)
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object")]


@app.command()
def bus(
    seconds: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="Length of each part in seconds")
    ] = 10.0,
    megabytes: Annotated[float, typer.Option(min=0.001, max=30.0, help="Size of an image")] = 1.0,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the router that is started")] = 17447,
    as_json: JsonOption = False,
) -> None:
    """Measure the latency of images through the local router, beside plain Zenoh and with a slow subscriber.

    Example: beamsplat bench bus --seconds 20 --json
    """
    from beamsplat.tools.bench.bus import bench_bus

    result = bench_bus(seconds, int(megabytes * 1e6), f"tcp/127.0.0.1:{port}", console.print)
    if as_json:
        print(json.dumps(result))
        return
    table = Table("figure", "value")
    for name, value in result.items():
        table.add_row(name, f"{value:.2f}" if isinstance(value, float) else str(value))
    Console().print(table)


@app.command()
def slam(
    data: Annotated[
        Path, typer.Option(help="Folder with X.bag beside X.relations, or bag/ beside groundtruth.txt")
    ],
    out: Annotated[
        Path,
        typer.Option(callback=writable, help="Folder for maps, trajectories and an overview of the maps"),
    ],
    no_odometry: Annotated[bool, typer.Option("--no-odometry", help="Use only the scans")] = False,
    readme: Annotated[Path | None, typer.Option(help="Put the table between its marks in this file")] = None,
    pictures: Annotated[Path | None, typer.Option(help="File of the overview of the maps")] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure accuracy and cost of the lidar SLAM on recordings with ground truth, beside Cartographer.

    Examples:

        beamsplat bench slam --data logs --out out/slam

        beamsplat bench slam --data logs --out out/slam --readme README.md --pictures docs/slam_maps.jpg
    """
    from beamsplat.tools.bench.readme import replace_readme_table
    from beamsplat.tools.bench.slam import bench_slam, markdown, write_map_overview

    rows = bench_slam(data, out, not no_odometry, lambda text: console.print(text, highlight=False))
    table = markdown(rows)
    print(json.dumps(rows) if as_json else table)
    if readme is not None:
        replace_readme_table(readme, "slam", table)
    write_map_overview(out, [row["name"] for row in rows], pictures or out / "maps.jpg")


@app.command()
def sites(
    out: Annotated[
        Path, typer.Option(callback=writable, help="Folder for recordings and maps; recordings are reused")
    ],
    only: Annotated[list[str] | None, typer.Option(help="Only this floor; repeatable")] = None,
    size: Annotated[str, typer.Option(help="Size of each floor in metres")] = "120x80",
    distance_m: Annotated[float, typer.Option(min=20.0, help="Driven distance on each floor")] = 3000.0,
    as_json: JsonOption = False,
) -> None:
    """Measure the lidar SLAM on large simulated office floors: errors, wrong loop closures, revisits, cost.

    The floors: office, office_lost (three stretches of 30 s without measurements, into unknown space),
    aliased (identical rooms along identical corridors), aliased_lost. The table is also written to table.md.

    Examples:

        beamsplat bench sites --out out/sites

        beamsplat bench sites --out out/sites --only aliased --distance-m 1000 --json
    """
    from beamsplat.tools.bench.sites import bench_sites, markdown

    rows = bench_sites(out, only, size, distance_m, lambda text: console.print(text, highlight=False))
    table = markdown(rows)
    (out / "table.md").write_text(table + "\n")
    print(json.dumps(rows) if as_json else table)


@app.command()
def uncertainties(
    data: Annotated[
        Path,
        typer.Option(exists=True, file_okay=False, help="Folder with bag/ beside groundtruth.txt"),
    ],
    as_json: JsonOption = False,
) -> None:
    """Compare stated standard deviations (localization, calibration of the camera, depth) with true errors.

    The normalised error is the RMS of error / stated standard deviation: 1 is honest, more is too optimistic.

    Example: beamsplat bench uncertainties --data recordings
    """
    from beamsplat.tools.bench.uncertainties import bench_uncertainties

    rows = bench_uncertainties(data, lambda text: console.print(text, highlight=False))
    if as_json:
        print(json.dumps(rows))
        return
    table = Table("quantity", "unit", "samples", "RMS error", "mean sigma", "normalised error")
    for row in rows:
        figures = (f"{row[key]:.3g}" for key in ("rms_error", "mean_sigma", "normalised_error"))
        table.add_row(row["quantity"], row["unit"], str(row["samples"]), *figures)
    Console().print(table)


@app.command()
def diagnosis(
    data: Annotated[Path, typer.Option(help="Folder or bag with camera, lidar and wheel odometry")],
    start_s: Annotated[float, typer.Option(min=0.0, help="Seconds after the start of the recording")] = 0.0,
    duration_s: Annotated[float, typer.Option(min=20.0, help="Seconds used for each fault")] = 40.0,
    as_json: JsonOption = False,
) -> None:
    """Plant twelve faults in a drive and show what the check of the calibration says about each.

    Example: beamsplat bench diagnosis --data recordings/house_a
    """
    from beamsplat.tools.bench.diagnosis import bench_diagnosis

    rows = [
        {
            "fault": row.fault.name, "right": row.right, "cause": row.health.cause if row.health else "",
            "status": row.health.status if row.health else "not enough data",
        }
        for row in bench_diagnosis(data, start_s, duration_s, lambda text: console.print(text, markup=False))
    ]  # fmt: skip
    if as_json:
        print(json.dumps(rows))
    else:
        print(f"{sum(bool(row['right']) for row in rows)} of {len(rows)} named right")


@app.command()
def paper(
    data: Annotated[
        Path, typer.Option(help="Folder with bag/ and its ground truth, or a bag that contains poses")
    ],
    out: Annotated[Path, typer.Option(callback=writable, help="Folder for report.json and report.html")],
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each configuration")] = 1,
    only: Annotated[list[str] | None, typer.Option(help="Only this configuration; repeatable")] = None,
    recorded: Annotated[
        Path | None,
        typer.Option(help="Folder of depth maps by stamp, used for networks whose weights are missing"),
    ] = None,
    groundtruth: Annotated[Path | None, typer.Option(help="TUM file of the true body poses")] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="Use only the first seconds of the recording")
    ] = None,
    refine_steps: Annotated[
        int, typer.Option(min=0, help="Steps on the default configuration's map after the drive, 0.1 s each")
    ] = 500,
    readme: Annotated[Path | None, typer.Option(help="Put the table between its marks in this file")] = None,
    as_json: JsonOption = False,
) -> None:
    """Run the paper's six configurations and the default one live in real time; print its Tables I-IV.

    A network whose weights are missing is replaced by FastDepth (or by --recorded) and named as such.

    Examples:

        beamsplat bench paper --data drive --out out/paper

        beamsplat bench paper --data drive --out out/paper --only default --only monogs-lidar --seeds 3
    """
    from beamsplat.tools.bench.paper import bench_paper
    from beamsplat.tools.bench.readme import paper_table, replace_readme_table

    report = bench_paper(
        data, out, names=only, seeds=seeds, recorded=recorded, groundtruth=groundtruth, seconds=seconds,
        refine_steps=refine_steps,
        log=lambda text: console.print(text, markup=False, highlight=False, soft_wrap=True),
    )  # fmt: skip
    if readme is not None:
        replace_readme_table(readme, "paper", paper_table(report["configurations"]))
    if as_json:
        print(json.dumps(report))
        return
    keys = (
        "position_rmse_m", "ate_sim3_rmse_m", "fps", "cpu_load_percent", "depth_rmse_scaled_m",
        "psnr_offpath_db",
    )  # fmt: skip
    table = Table("configuration", *keys)
    for row in report["configurations"]:
        values = [row.get(key) for key in keys]
        table.add_row(f"{row['name']} #{row['seed']}", *("-" if v is None else f"{v:.4g}" for v in values))
    Console().print(table)
    print(f"{out / 'report.html'}\n{out / 'report.json'}")


@app.command()
def sensitivity(
    part: Annotated[str, typer.Option(help="slam, fusion or map")],
    data: Annotated[
        Path, typer.Option(exists=True, file_okay=False, help="Folder with bag/ beside its ground truth")
    ],
    only: Annotated[list[str] | None, typer.Option(help="Only this parameter; repeatable")] = None,
    seconds: Annotated[
        float | None, typer.Option(min=1.0, help="Use only the first seconds of the recording")
    ] = None,
    minutes: Annotated[float | None, typer.Option(min=0.0, help="Start no run later than this")] = None,
    out: Annotated[
        Path,
        typer.Option(callback=writable, help="Append each run to this file; runs in it are not repeated"),
    ] = Path("out/sensitivity.jsonl"),
    markdown: Annotated[Path | None, typer.Option(help="Write the table into this page")] = None,
    as_json: JsonOption = False,
) -> None:
    """Change each setting of SLAM, fusion or mapper by -30 and +30 %; print the effect on metrics.

    Start with a new --out file after a change of the code.

    Examples:

        beamsplat bench sensitivity --part slam --data drive

        beamsplat bench sensitivity --part map --data drive --only stride_px --only opacity --json
    """
    import time

    from beamsplat.common.errors import UserError
    from beamsplat.tools.bench.sensitivity import chosen, measure
    from beamsplat.tools.bench.sensitivity_parts import PARTS
    from beamsplat.tools.bench.sensitivity_table import as_json as result_json
    from beamsplat.tools.bench.sensitivity_table import markdown as table_of
    from beamsplat.tools.bench.sensitivity_table import write_page

    if part not in PARTS:
        raise UserError(f"--part {part}: unknown; known are {', '.join(PARTS)}")
    measured, length_s = PARTS[part], seconds or PARTS[part].seconds
    setup = {"part": part, "data": data.resolve().name, "seconds": length_s}
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=console, transient=True,
    )  # fmt: skip
    with bar:
        task = bar.add_task("loading", total=None)
        rows = measure(
            measured, lambda: measured.open(data, length_s), chosen(measured, only), out, setup,
            float("inf") if minutes is None else minutes,
            lambda name, done, total: bar.update(task, description=name, completed=done, total=total),
        )  # fmt: skip
    everything = chosen(measured, None)
    command = f"beamsplat bench sensitivity --part {part} --data {setup['data']} --seconds {length_s:g}"
    table = table_of(measured, everything, rows, command, time.strftime("%Y-%m-%d"))
    if markdown is not None:
        write_page(markdown, part, table)
    print(json.dumps(result_json(measured, everything, rows, setup)) if as_json else table)
