"""`beamsplat session`: inspect saved maps, add the robot half, merge two maps, prune.

A session has two halves: the edge half (Gaussians and keyframes) and the robot half (the lidar map).
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from beamsplat.common.errors import UserError
from beamsplat.tools.cli.options import parsed_pose, session_folder, writable
from beamsplat.tools.sessions.opened import (
    ROBOT_MANIFEST,
    created,
    faults_explained,
    load_slam,
    locked,
    newer_keyframes,
    read_saved,
    write_saved,
)

if TYPE_CHECKING:
    from beamsplat.common.files.numbered_state import Arrays
    from beamsplat.common.mapfiles.session import SessionFolder

console = Console(stderr=True)
app = typer.Typer(no_args_is_help=True, help="Saved maps: inspect, join, merge, prune, edit.")
SessionArgument = Annotated[
    Path, typer.Argument(callback=session_folder, help="Folder written by `mapping.session = DIR`")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object")]
_AROUND_NS = 60_000_000_000  # largest time between a keyframe and the scans of the same drive


@app.command()
def info(session: SessionArgument, as_json: JsonOption = False) -> None:
    """Print what a session contains, and which of its two halves exist.

    Example: beamsplat session info map
    """
    from beamsplat.common.engines.protocol import identity_in
    from beamsplat.common.mapfiles.session import SessionFolder

    folder = SessionFolder(session)
    head, manifest = folder.header(), folder.manifest()
    edge: dict[str, Any] | None = None
    engine = None if manifest is None else identity_in(manifest)
    if manifest is not None:
        edge = {k: manifest[k] for k in ("keyframes", "gaussians", "anchors", "steps", "stamp_ns", "bytes")}
        edge["engine"] = None if engine is None else asdict(engine)
        edge["keyframes_on_disk"] = len(folder.keyframe_ids())
        state = folder.read_state()
        assert state is not None  # there is a manifest
        edge["keyframes_newer"] = newer_keyframes(folder, state)
        edge["map_uuid"] = _map_uuid(state)
    robot = _robot_summary(folder.robot) if (folder.robot / ROBOT_MANIFEST).is_file() else None
    table = {"uuid": head["uuid"], "version": head["version"], "edge": edge, "robot": robot}
    if as_json:
        print(json.dumps(table))
        return
    print(f"session {head['uuid']}, format {head['version']}")
    if edge is None:
        print("edge half: nothing saved yet")
    else:
        print(
            f"edge half: {edge['keyframes']} keyframes, {edge['gaussians']} Gaussians on {edge['anchors']} "
            f"anchors, {edge['steps']} steps, {edge['bytes'] / 1e6:.1f} MB; {edge['keyframes_on_disk']} "
            f"keyframes on disk, {edge['keyframes_newer']} of them newer than the checkpoint; robot map "
            f"{edge['map_uuid'] or 'without a UUID'}; computed by {engine or 'an unknown engine'}"
        )
    if robot is None:
        print("robot half: none (`beamsplat session join` adds it)")
    else:
        print(f"robot half: {robot['submaps']} submaps, {robot['keynodes']} nodes, "
              f"{robot['constraints']} constraints, map {robot['uuid'] or 'without a UUID'}")  # fmt: skip


def _map_uuid(arrays: Arrays) -> str:
    """Return the UUID of the robot map that the anchors of a session belong to; "" if it is unknown."""
    return str(next(iter(arrays.get("extra_map_uuid", [])), ""))


def _robot_summary(path: Path) -> dict[str, Any]:
    table = json.loads((path / ROBOT_MANIFEST).read_text())
    counts = {key: int(table[key]) for key in ("submaps", "keynodes", "constraints")}
    return counts | {"uuid": str(table.get("uuid", ""))}


@app.command()
def join(
    session: SessionArgument,
    robot: Annotated[
        Path, typer.Argument(help="State of the lidar SLAM: `localization.save`, or `state/` of `slam`")
    ],
) -> None:
    """Add the robot half to a session, and move the map to the anchor poses of the robot's last optimisation.

    Example: beamsplat session join map robot_state
    """
    from beamsplat.common.geometry.transforms import se2_to_se3
    from beamsplat.tools.sessions.edit import with_anchors

    with locked(session) as folder:
        arrays = read_saved(folder)
        slam = load_slam(robot)
        _same_drive(session, robot, arrays, slam)
        T_map_anchor = {id: se2_to_se3(pose) for id, pose in slam.anchors().items()}
        write_saved(folder, with_anchors(arrays, T_map_anchor), slam)
    missing = [a for a in arrays["anchor_id"].tolist() if a >= 0 and a not in T_map_anchor]
    more = f"; {len(missing)} anchors that the robot has removed keep their pose" if missing else ""
    print(f"{session}: {len(T_map_anchor)} submaps joined{more}")


@app.command()
def merge(
    first: Annotated[Path, typer.Argument(callback=session_folder, help="Session whose map frame is kept")],
    second: Annotated[
        Path, typer.Argument(callback=session_folder, help="Session of another drive through the same place")
    ],
    out: Annotated[
        Path, typer.Option(callback=writable, help="Folder for the merged session; must not contain one")
    ],
    place: Annotated[
        str,
        typer.Option(
            metavar="X,Y,DEG",
            help="Pose of the second map's origin in the first map; default: found by lidar",
        ),
    ] = "",
) -> None:
    """Merge the maps of two drives. If both have a robot half, lidar scans align them.

    A mapper that resumes on the merged session optimises the borders between the two maps.

    Examples:

        beamsplat session merge monday tuesday --out both

        beamsplat session merge hall annex --out both --place 12.4,-3.1,90
    """
    from beamsplat.common.mapfiles.session import SessionFolder

    target = SessionFolder(out)
    if target.exists():
        raise UserError(f"{out}: contains a session already; choose another folder")
    with locked(first, shared=True) as folder_a, locked(second, shared=True) as folder_b, created(target):
        arrays, before, doubt = _merged(folder_a, folder_b, target, place)
    left, count = arrays["store_params"].shape[1], len(arrays["keyframe_id"])
    print(f"{out}: {count} keyframes, {left} Gaussians; {before - left} duplicates removed")
    if doubt:
        console.print(
            f"{out} was written, but do not trust it: {doubt}. Look at it (beamsplat export {out} --to ply), "
            "or remove it and merge again with --place X,Y,DEG", style="red", markup=False, soft_wrap=True,
        )  # fmt: skip
        raise typer.Exit(3)


def _merged(
    folder_a: SessionFolder, folder_b: SessionFolder, target: SessionFolder, place: str
) -> tuple[Arrays, int, str]:
    """Write the merge of two locked sessions to a third.

    Returns:
        Its arrays, the number of Gaussians before duplicates were removed, and why the pose may be wrong.
    """
    from rich.progress import track

    from beamsplat.common.geometry.transforms import se2_to_se3
    from beamsplat.tools.sessions.edit import merged, with_anchors
    from beamsplat.tools.sessions.merge import deduplicated, merge_doubt

    a, b = read_saved(folder_a), read_saved(folder_b)
    both = all((folder.robot / ROBOT_MANIFEST).is_file() for folder in (folder_a, folder_b))
    slams = [load_slam(folder.robot) for folder in (folder_a, folder_b)] if both else []
    alignment = None if place else _aligned(folder_a.path, folder_b.path, slams)
    pose_a_b = parsed_pose(place) if alignment is None else alignment.pose_a_b
    known = [*a["anchor_id"].tolist(), *(slams[0].pose_graph.submaps if slams else [])]
    offset = max([*known, -1]) + 2  # -1 is the odom origin of the second map
    arrays, doubt = merged(a, b, se2_to_se3(pose_a_b), offset), ""
    if slams:
        from beamsplat.services.localization.lidar2d.merge import merge_into

        loops = merge_into(slams[0], slams[1], pose_a_b, offset)
        arrays = with_anchors(arrays, {id: se2_to_se3(pose) for id, pose in slams[0].anchors().items()})
        console.print(f"{loops} loop closures between the drives")
        if alignment is not None:
            doubt = merge_doubt(alignment.agreeing, alignment.queried, loops)
    ids = set(arrays["keyframe_id"].tolist())
    with faults_explained(target):
        for folder in (folder_a, folder_b):
            for id in ids.intersection(folder.keyframe_ids()):
                target.write_keyframe(id, *folder.read_keyframe(id))
    before = arrays["store_params"].shape[1]
    arrays = deduplicated(
        target, arrays, offset, lambda views: track(views, "comparing", console=console, transient=True)
    )
    write_saved(target, arrays, slams[0] if slams else None)
    return arrays, before, doubt


@app.command()
def prune(
    session: SessionArgument,
    opacity: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Remove Gaussians with a lower opacity")
    ] = 0.05,
    keyframes: Annotated[
        int | None,
        typer.Option(min=1, help="How many keyframes to keep, evenly spaced in time; default: all"),
    ] = None,
) -> None:
    """Make a session smaller: remove faint Gaussians and surplus keyframes, also from the disk.

    Example: beamsplat session prune map --keyframes 400
    """
    from beamsplat.common.mapfiles.state import progress_of
    from beamsplat.tools.sessions.edit import pruned

    with locked(session) as folder:
        arrays = read_saved(folder)
        before = _bytes(session)
        out = pruned(arrays, opacity, keyframes)
        write_saved(folder, out)
        folder.remove_keyframes(progress_of(out)["forgotten"])
    gaussians = [a["store_params"].shape[1] for a in (arrays, out)]
    print(
        f"{session}: {gaussians[0]} -> {gaussians[1]} Gaussians, {len(arrays['keyframe_id'])} -> "
        f"{len(out['keyframe_id'])} keyframes, {before / 1e6:.1f} -> {_bytes(session) / 1e6:.1f} MB"
    )


def _bytes(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def _same_drive(session: Path, robot: Path, arrays: Arrays, slam: Any) -> None:
    """Check that a session and a lidar map are of the same drive.

    Their UUIDs are compared; for older states without a UUID, the stamps of keyframes and scans.

    Raises:
        UserError: they are of different drives, or one of them is empty.
    """
    import numpy as np

    mine, its = _map_uuid(arrays), slam.pose_graph.uuid
    if mine and its and mine != its:
        raise UserError(
            f"{robot}: is the robot half of map {its}, but {session} belongs to map {mine}: it is of another "
            "drive. Give the state that localization.save wrote in the drive of the session, or use `merge`"
        )

    scans_ns = np.array([node.stamp_ns for node in slam.pose_graph.nodes.values()])
    stamps_ns = arrays["extra_taken_stamp_ns"]
    if len(scans_ns) == 0 or len(stamps_ns) == 0:
        raise UserError(f"{robot if len(scans_ns) == 0 else session}: is empty; there is nothing to join")
    inside = (stamps_ns >= scans_ns.min() - _AROUND_NS) & (stamps_ns <= scans_ns.max() + _AROUND_NS)
    if inside.mean() < 0.9:
        raise UserError(
            f"{robot}: only {inside.mean():.0%} of the keyframes of {session} were taken during its scans: "
            "it is the robot half of another drive"
        )


def _aligned(first: Path, second: Path, slams: list[Any]) -> Any:
    """Return the alignment of the second map to the first, estimated from lidar scans.

    Its pose_a_b float64 [3] (x m, y m, yaw rad) is the pose of the second map in the first.

    Raises:
        UserError: a robot half is missing, or the scans do not agree on a pose.
    """
    if not slams:
        raise UserError(
            f"{first} or {second} has no robot half, which the alignment needs: add it first "
            "(`beamsplat session join`), or give the pose of the second map with --place X,Y,DEG"
        )
    from beamsplat.services.localization.lidar2d.merge import find_alignment

    alignment = find_alignment(*slams)
    if alignment is None:
        raise UserError(
            f"the scans of {second} do not agree on one pose in {first}: "
            "give the pose of the second map with --place X,Y,DEG"
        )
    console.print(f"{alignment.agreeing} of {alignment.queried} scans agree on the pose of the second map")
    return alignment
