"""Commands `beamsplat calibrate extrinsics` and `beamsplat calibrate time`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from beamsplat.common.errors import UserError
from beamsplat.tools.cli.depth import JsonOption, PosesOption, RigOption

app = typer.Typer(no_args_is_help=True, help="Calibrate camera, lidar and their clocks.")


@app.command("extrinsics")
def extrinsics(
    data: Annotated[
        Path, typer.Argument(help="A recorded drive; with --target board: a folder with images/ and lasers/.")
    ],
    poses: PosesOption = None,
    rig: RigOption = None,
    target: Annotated[
        str, typer.Option(help="`motion` (a recorded drive), or `board` (still pairs).")
    ] = "motion",
    corners: Annotated[str, typer.Option(help="Inner corners of the chessboard.")] = "11x8",
    square_m: Annotated[float, typer.Option(min=0.001, help="Side of a square.")] = 0.019,
    as_json: JsonOption = False,
) -> None:
    """Estimate the mount of the camera from the motion of a drive, or from beams on a board.

    Prints standard errors, and the parameters that a planar lidar cannot observe.

    Examples:

        beamsplat calibrate extrinsics drive --poses out/trajectory.tum

        beamsplat calibrate extrinsics pairs --target board --rig rig.toml
    """
    from beamsplat.services.fusion.calibration.motion import PARAMETERS
    from beamsplat.tools.evaluation.calibrate import calibrate_board, calibrate_motion, motion_report
    from beamsplat.tools.evaluation.drive import open_drive

    if target == "board":
        if rig is None:
            raise UserError("--target board needs --rig rig.toml with the camera's K and distortion")
        columns, x, rows = corners.partition("x")
        if not (x and columns.isdigit() and rows.isdigit()):
            raise UserError(f"--corners {corners!r}: expected COLUMNSxROWS, for example 11x8")
        _show(calibrate_board(data, rig, (int(columns), int(rows)), square_m), as_json)
        return
    if target != "motion":
        raise UserError(f"--target {target!r}: expected motion or board")
    drive = open_drive(data, poses, rig)
    _show(motion_report(drive, calibrate_motion(drive, PARAMETERS[1:])), as_json)


@app.command("time")
def clock(
    data: Annotated[Path, typer.Argument(help="A recorded drive.")],
    poses: PosesOption = None,
    rig: RigOption = None,
    shift_ms: Annotated[
        float, typer.Option(min=-1000.0, max=1000.0, help="Add this offset first, to test the estimate.")
    ] = 0.0,
    as_json: JsonOption = False,
) -> None:
    """Estimate the offset to add to the camera's stamps so that they match the lidar's clock.

    Example: beamsplat calibrate time drive --poses out/trajectory.tum
    """
    from beamsplat.tools.evaluation.calibrate import calibrate_motion, motion_report, with_clock_offset
    from beamsplat.tools.evaluation.drive import open_drive

    drive = open_drive(data, poses, rig)
    if shift_ms:
        drive = with_clock_offset(drive, round(shift_ms * 1e6))
    _show(motion_report(drive, calibrate_motion(drive, ("clock_s",))), as_json)


def _show(report: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(report))
        return
    for name, value in report.items():
        if name.endswith("_sigma") or value is None:  # printed with its value; not estimated
            continue
        sigma = report.get(f"{name}_sigma")
        print(f"{name}:{_text(value)}" + (f" ± {sigma:.4f}" if sigma is not None else ""))


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f" {value:.4f}"
    if isinstance(value, list) and value and isinstance(value[0], list):  # a matrix
        return "".join("\n    " + "  ".join(f"{number:9.5f}" for number in row) for row in value)
    return " " + ("; ".join(map(str, value)) if isinstance(value, list) else str(value))
