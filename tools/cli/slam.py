"""`beamsplat slam` and `beamsplat eval slam`: map a recording with the lidar SLAM, measure the accuracy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from beamsplat.common.errors import UserError
from beamsplat.tools.cli.options import OdometryTopic, ScanTopic, writable

console = Console(stderr=True)
JsonOption = Annotated[bool, typer.Option("--json", help="Print the figures as one JSON object")]


def slam(
    bag: Annotated[Path, typer.Argument(help="Bag, recording or folder with a 2D lidar")],
    out: Annotated[Path, typer.Option(callback=writable, help="Folder for trajectory, map and state")],
    no_odometry: Annotated[bool, typer.Option("--no-odometry", help="Use the scans only")] = False,
    rig: Annotated[Path | None, typer.Option(help="Calibration file, if the bag has none")] = None,
    scan_topic: ScanTopic = "",
    odometry_topic: OdometryTopic = "",
    as_json: JsonOption = False,
) -> None:
    """Map a recording with the lidar SLAM, as fast as the machine allows.

    Writes trajectory.tum (after the last optimisation), online.tum (as it would have been published), map.pgm
    and map.yaml (nav2), map.png, state/ (to continue or localize in), figures.json.

    Examples:

        beamsplat slam drive/bag --out map

        beamsplat slam drive/bag --out map2 --no-odometry --json
    """
    from beamsplat.services.localization.lidar2d.offline_mapping import MeasurementLog, map_measurements
    from beamsplat.services.replay.options import SourceOptions
    from beamsplat.services.replay.source import open_source
    from beamsplat.tools.evaluation.slam import measurements

    without = {"image", "pose"} | ({"odometry"} if no_odometry else set())
    options = SourceOptions(
        scan_topic=scan_topic, odometry_topic=odometry_topic, rig=rig, without=frozenset(without),
        require=frozenset({"scan"}),
    )  # fmt: skip
    source = open_source(bag, options)
    try:
        for choice in getattr(source, "choices", ()):
            console.print(f"[green]{choice}[/]", highlight=False)
        lidar = source.rig().lidar
        if lidar is None:
            raise UserError(
                f"{bag}: the calibration has no lidar; give one with --rig (`beamsplat rig` drafts it)"
            )
        bar = Progress(
            TextColumn("mapping"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
            TimeRemainingColumn(), console=console, transient=True,
        )  # fmt: skip
        with bar:
            task = bar.add_task("mapping", total=source.message_count())
            log = MeasurementLog(lidar.T_body_lidar, measurements(source), lambda: bar.advance(task))
            figures = map_measurements(log, out)
        reader = source.scan_reader() if hasattr(source, "scan_reader") else None
        if reader is not None:
            console.print(f"{reader.topic}: {reader.learner.evidence()}", markup=False, highlight=False)
        for problem in source.problems:
            console.print(problem, style="yellow", markup=False, highlight=False)
    finally:
        source.close()
    if as_json:
        print(json.dumps(figures))
    else:
        print_figures(figures)
        for reason, count in figures["refused"].items():
            console.print(f"{count} scans: {reason}", markup=False, highlight=False)
        for text in _remarks(figures):
            console.print(text, markup=False, highlight=False)
        console.print(f"wrote trajectory.tum, online.tum, map.pgm, map.yaml, map.png and state/ to {out}")


def _remarks(figures: dict[str, Any]) -> list[str]:
    """Return what was found out about the sensors during the drive, in sentences."""
    remarks = []
    odometry = figures["odometry"]
    if odometry is not None and odometry["text"]:
        remarks.append(f"wheel odometry: {odometry['text']}")
    if figures["self_returns"]:
        from beamsplat.services.localization.lidar2d.self_returns import Sector, sectors_text

        remarks.append(sectors_text([Sector(**sector) for sector in figures["self_returns"]]))
    return remarks


def eval_slam(
    folder: Annotated[
        Path,
        typer.Argument(help="Folder written by `beamsplat slam`, or a trajectory (TUM file of body poses)"),
    ],
    relations: Annotated[Path | None, typer.Option(help="Relations file (Kuemmerle et al. 2009)")] = None,
    groundtruth: Annotated[Path | None, typer.Option(help="TUM file of the true body poses")] = None,
    as_json: JsonOption = False,
) -> None:
    """Compute the errors of a trajectory against relations or a true trajectory; the scale is never fitted.

    With a true trajectory also: wrong loop closures in the saved map (off by more than 0.5 m or 5 degrees),
    and the share of true revisits that the map joins (relative pose within 0.15 m). With a folder: its costs.

    Examples:

        beamsplat eval slam map --relations intel.relations

        beamsplat eval slam map --groundtruth groundtruth.txt --json

        beamsplat eval slam out/demo/trajectory.tum --groundtruth groundtruth.txt
    """
    if (relations is None) == (groundtruth is None):
        raise UserError("eval slam needs either --relations FILE or --groundtruth FILE")
    from beamsplat.tools.evaluation.slam import costs, errors_against_truth

    figures = (
        _against_relations(folder, relations) if relations else errors_against_truth(folder, groundtruth)
    ) | costs(folder)
    if as_json:
        print(json.dumps(figures))
    else:
        print_figures(figures)


def _against_relations(folder: Path, path: Path) -> dict[str, Any]:
    """Return the errors of a trajectory against relations (relative poses of the lidar), by name.

    `folder` is the output of `beamsplat slam`, or one trajectory file in it; `path` is the relations file.
    """
    from dataclasses import asdict

    import numpy as np

    from beamsplat.services.localization.lidar2d.metrics import read_relations, relation_errors
    from beamsplat.tools.evaluation.slam import planar_poses

    folder, name = (folder.parent, folder.name) if folder.is_file() else (folder, "trajectory.tum")
    if not (folder / "figures.json").is_file():
        raise UserError(
            f"{folder}: no figures.json, which says where the lidar is mounted; relations need a folder that "
            "`beamsplat slam` wrote"
        )
    stamps_ns, pose_map_body = planar_poses(folder / name)
    relation_stamps_ns, relative = read_relations(path)
    pose_body_lidar = np.array(json.loads((folder / "figures.json").read_text())["T_body_lidar"])
    return asdict(relation_errors(stamps_ns, pose_map_body, relation_stamps_ns, relative, pose_body_lidar))


def print_figures(figures: dict[str, Any]) -> None:
    """Print the numbers and texts in `figures` as a table with two columns, name and value.

    Entries of other types, such as lists, are left out.
    """
    table = Table("figure", "value")
    for name, value in figures.items():
        if isinstance(value, (int, float, str)):
            table.add_row(name, f"{value:.4f}" if isinstance(value, float) else str(value))
    Console().print(table)
