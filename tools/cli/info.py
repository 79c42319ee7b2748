"""Commands `beamsplat info` and `beamsplat rig`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from beamsplat.common.errors import UserError
from beamsplat.tools.cli.options import CameraInfoTopic, ImageTopic, OdometryTopic, ScanTopic, writable

if TYPE_CHECKING:
    from beamsplat.services.replay.inspection import InspectionReport

# Bag readers and OpenCV are imported where they are used, so that other commands start fast.


def info(
    path: Annotated[
        Path, typer.Argument(help="A bag (.bag, .mcap, .db3, folder), a recording or a plain folder.")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
    rig: Annotated[
        Path | None, typer.Option(help="A rig file that overrides the calibration in the data.")
    ] = None,
    allow_truncated: Annotated[
        bool, typer.Option(help="Inspect the readable part of a truncated bag.")
    ] = False,
    scan_topic: ScanTopic = "",
    image_topic: ImageTopic = "",
    odometry_topic: OdometryTopic = "",
    pose_topic: Annotated[str, typer.Option(help="Topic of poses from outside, likewise.")] = "",
    camera_info_topic: CameraInfoTopic = "",
) -> None:
    """Show the content of a bag or recording: topics, rates, gaps, sensors, calibration, problems.

    If the data cannot be played, the exit code is 2, and one sentence states the reason.

    Example: beamsplat info drive/bag
    """
    from beamsplat.services.replay.inspection import inspect
    from beamsplat.services.replay.options import SourceOptions

    options = SourceOptions(
        rig=rig, allow_truncated=allow_truncated, scan_topic=scan_topic, image_topic=image_topic,
        odometry_topic=odometry_topic, pose_topic=pose_topic, camera_info_topic=camera_info_topic,
    )  # fmt: skip
    report = inspect(path, options)
    if as_json:
        print(json.dumps(report.as_dict()))
    else:
        console = Console(soft_wrap=True, highlight=False)
        _print(
            report, console if console.is_terminal else Console(width=200, soft_wrap=True, highlight=False)
        )
    if report.error:
        raise UserError(report.error)


def rig(
    source: Annotated[
        str, typer.Argument(help="A bag, recording or folder, or a camera: index, /dev/videoN, URL.")
    ],
    out: Annotated[Path, typer.Option(callback=writable, help="File to write.")] = Path("rig.toml"),
    fov_deg: Annotated[
        float,
        typer.Option(help="Camera only: horizontal field of view from its data sheet.", min=10, max=170),
    ] = 65.0,
    overwrite: Annotated[bool, typer.Option(help="Replace an existing file.")] = False,
) -> None:
    """Write a draft of the rig file: values found, values assumed, and values to measure.

    Examples:

        beamsplat rig drive/bag --out rig.toml

        beamsplat rig /dev/video0 --fov-deg 78
    """
    from beamsplat.common.geometry.rig import write_rig
    from beamsplat.services.replay.rig_draft import draft_from_data, draft_from_device, is_device

    if out.exists() and not overwrite:
        raise UserError(f"{out}: exists already; choose another name with --out, or use --overwrite")
    text, notes = draft_from_device(source, fov_deg) if is_device(source) else draft_from_data(Path(source))
    write_rig(out, text)
    console = Console(soft_wrap=True, highlight=False)
    for note in notes:
        console.print(f"  {escape(note)}")
    console.print(f"[green]written:[/] {escape(str(out))}")


def _print(report: InspectionReport, console: Console) -> None:
    size_mb = report.bytes / 1e6
    console.print(
        f"[bold]{escape(report.path)}[/]: {report.kind}, {report.duration_s:.1f} s, {size_mb:.1f} MB"
    )
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("topic", "type"):
        table.add_column(name, no_wrap=True)
    for name in ("messages", "Hz", "gap s", "gaps", "lag ms", "played as"):
        table.add_column(name, justify="right")
    words = {topic: word for word, topic in report.sensors.items()}
    for facts in report.topics:
        short = facts.type.split("/msg/")[-1]
        table.add_row(
            escape(facts.name), escape(short), str(facts.count), _number(facts.rate_hz, 1),
            _number(facts.largest_gap_s, 2), str(facts.gaps or ""), _number(facts.lag_median_ms, 0),
            words.get(facts.name, ""),
        )  # fmt: skip
    console.print(table)
    if report.lidar is not None:
        lidar = report.lidar
        console.print(
            f"[bold]lidar[/]: {lidar.beams_max} beams over {lidar.field_of_view_deg:.1f} deg, "
            f"{lidar.range_min_m:g} to {lidar.range_max_m:g} m; no return {lidar.no_return_share:.1%}, "
            f"invalid {lidar.invalid_share:.1%}, beyond range_max {lidar.beyond_share:.1%}"
        )
    if report.camera is not None:
        camera = report.camera
        text = f"{camera.get('width_px')}x{camera.get('height_px')} px {camera.get('encoding') or ''}".strip()
        if "fx_px" in camera:
            text += "".join(f", {name} {camera[name + '_px']:.1f}" for name in ("fx", "fy", "cx", "cy"))
            text += f", distortion {camera['distortion_model']}"
        console.print(f"[bold]camera[/]: {text}")
    for title, colour, lines in (
        ("chosen", "green", report.choices),
        ("calibration found", "green", report.calibration_found),
        ("assumed", "yellow", report.calibration_assumed),
        ("missing", "red", report.calibration_missing),
        ("problems", "yellow", report.problems),
    ):
        for line in lines:
            console.print(f"[{colour}]{title}:[/] {escape(line)}")


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
