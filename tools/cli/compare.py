"""`beamsplat compare` and `beamsplat eval compare`: what changed between two sessions, and its score."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from beamsplat.common.errors import UserError
from beamsplat.tools.cli.options import parsed_pose, session_folder, writable
from beamsplat.tools.cli.session import JsonOption
from beamsplat.tools.sessions.opened import ROBOT_MANIFEST, load_slam, locked, read_saved

console = Console(stderr=True)


def compare(
    first: Annotated[
        Path,
        typer.Argument(callback=session_folder, help="Session of the first drive; results are in its frame"),
    ],
    second: Annotated[
        Path, typer.Argument(callback=session_folder, help="Session of a later drive through the same place")
    ],
    out: Annotated[Path, typer.Option(callback=writable, help="Folder for the results")],
    place: Annotated[
        str,
        typer.Option(
            metavar="X,Y,DEG",
            help="Rough pose of the second map's origin in the first map; default: found by lidar",
        ),
    ] = "",
    threads: Annotated[int, typer.Option(min=1, help="Threads of the rasterizer")] = 2,
    as_json: JsonOption = False,
) -> None:
    """Find what appeared and what vanished between two drives through one place.

    A place counts as changed only where one drive saw a surface and the other one looked through it: with the
    lidar, with the camera, or with both. What only one drive has seen is not reported. Both sessions need
    their robot half (the lidar map; `beamsplat session join` adds it).

    The folder gets changes.json (objects with box, volume, evidence and confidence, in metres in the frame of
    the first map), top_view.png (both maps with the objects marked), object_N.png (the place before and
    after), and changes.ply (surface of the first map; vanished red, appeared green).

    Examples:

        beamsplat compare monday tuesday --out changes

        beamsplat compare monday tuesday --out changes --place 0.5,-1.2,90 --json
    """
    from rich.progress import Progress

    from beamsplat.tools.compare.comparison import OpenedSession, compare_sessions, write_comparison

    with locked(first, shared=True) as folder_a, locked(second, shared=True) as folder_b:
        opened = []
        for folder in (folder_a, folder_b):
            if not (folder.robot / ROBOT_MANIFEST).is_file():
                raise UserError(
                    f"{folder.path}: has no robot half (lidar map), by which two drives are aligned; add it "
                    "with `beamsplat session join`"
                )
            opened.append(OpenedSession(folder, read_saved(folder), load_slam(folder.robot)))
        with Progress(console=console, transient=True) as bar:
            task = bar.add_task("reading", total=None)
            result = compare_sessions(
                opened[0], opened[1], parsed_pose(place) if place else None, threads,
                lambda stage, done, total: bar.update(
                    task, description=stage, completed=done, total=total or None
                ),
            )  # fmt: skip
    try:
        files = write_comparison(result, out)
    except OSError as error:
        raise UserError(f"--out {out}: cannot be written ({error.strerror})") from error
    if as_json:
        print(json.dumps(result.as_json()))
        return
    for number, found in enumerate(result.objects, 1):
        x, y, z = found.centre_m
        size = " x ".join(f"{v:.2f}" for v in found.high_m - found.low_m)
        print(
            f"{number}: {found.kind} at ({x:.2f}, {y:.2f}, {z:.2f}) m, {size} m, confidence "
            f"{found.confidence:.2f}: {found.cells} lidar cells, {found.voxels} voxels"
        )
    print(f"{len(result.objects)} changes; {files[-1]} and {len(files) - 1} more files in {out}")


def eval_compare(
    changes: Annotated[Path, typer.Argument(help="changes.json, written by `beamsplat compare`")],
    session: Annotated[
        Path, typer.Option(callback=session_folder, help="The first session of the comparison")
    ],
    truth: Annotated[Path, typer.Option(help="groundtruth.txt of the first simulated drive")],
    true_changes: Annotated[Path, typer.Option(help="changes.json of the second simulated drive")],
    as_json: JsonOption = False,
) -> None:
    """Score a comparison of two simulated drives: how many changes were found, how many reported are false.

    A moved object is found if its old and its new place are. The trajectory places the map in the world.

    Example: beamsplat eval compare changes/changes.json --session monday --truth before/groundtruth.txt
    --true-changes after/changes.json
    """
    from beamsplat.common.mapfiles.session import SessionFolder
    from beamsplat.tools.cli.slam import print_figures
    from beamsplat.tools.evaluation.changes import score_files

    figures = score_files(changes, load_slam(SessionFolder(session).robot), truth, true_changes)
    print(json.dumps(figures)) if as_json else print_figures(figures)
