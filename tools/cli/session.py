"""`beamsplat session`: what a saved map holds, halves joined, drives merged, the superfluous pruned."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from beamsplat.common.errors import UserError
from beamsplat.tools.cli.options import writable

console = Console(stderr=True)
app = typer.Typer(no_args_is_help=True, help="Saved maps: look into them, join, merge, prune.")
SessionArgument = Annotated[Path, typer.Argument(help="Folder written by `mapping.session = DIR`")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object")]
ROBOT_MANIFEST = "lidar_map.json"
_AROUND_NS = 60_000_000_000  # a keyframe lies that close to the scans of its own drive


@app.command()
def info(session: SessionArgument, as_json: JsonOption = False) -> None:
    """Says what a session holds, and whether its two halves are there.

    Example: beamsplat session info map
    """
    from beamsplat.common.mapfiles.session import SessionFolder

    folder = SessionFolder(session)
    head, manifest = folder.header(), folder.manifest()
    edge: dict[str, Any] | None = None
    if manifest is not None:
        edge = {k: manifest[k] for k in ("keyframes", "gaussians", "anchors", "steps", "stamp_ns", "bytes")}
        edge["keyframes_on_disk"] = len(folder.keyframe_ids())
        state = folder.read_state()
        edge["keyframes_newer"] = _newer(folder, state)
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
            f"keyframes on disk, {edge['keyframes_newer']} of them newer than the checkpoint; on the robot's "
            f"map {edge['map_uuid'] or 'without a UUID'}"
        )
    if robot is None:
        print("robot half: none (`beamsplat session join` puts one in)")
    else:
        print(f"robot half: {robot['submaps']} submaps, {robot['keynodes']} keynodes, "
              f"{robot['constraints']} constraints, map {robot['uuid'] or 'without a UUID'}")  # fmt: skip


def _map_uuid(arrays: dict[str, Any]) -> str:
    """Of the robot's map that a session hangs on; "" where nobody said."""
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
    """Puts the robot's half into a session, and the map where the robot's last optimisation says.

    Example: beamsplat session join map robot_state
    """
    from beamsplat.common.geometry.transforms import se2_to_se3
    from beamsplat.tools.sessions.edit import with_anchors

    folder, arrays = _open(session)
    slam = load_slam(robot)
    _same_drive(session, robot, arrays, slam)
    folder.lock()
    try:
        slam.save(folder.robot)
        places = {id: se2_to_se3(pose) for id, pose in slam.anchors().items()}
        _write(folder, with_anchors(arrays, places))
    finally:
        folder.unlock()
    missing = [a for a in arrays["anchor_id"].tolist() if a >= 0 and a not in places]
    more = f"; {len(missing)} anchors that the robot has given up stay where they were" if missing else ""
    print(f"{session}: {len(places)} submaps joined{more}")


@app.command()
def merge(
    first: Annotated[Path, typer.Argument(help="Session whose map frame stays")],
    second: Annotated[Path, typer.Argument(help="Session of another drive through the same place")],
    out: Annotated[
        Path, typer.Option(callback=writable, help="Folder for the merged session; must not hold one")
    ],
    place: Annotated[
        str,
        typer.Option(
            metavar="X,Y,DEG", help="Where the second map's origin lies in the first; default: found by lidar"
        ),
    ] = "",
) -> None:
    """Makes one map of two drives. Where the second lies, its scans tell, if both have a robot half.

    Seams mend as a mapper resumes on the merged session and ticks or keyframes come.

    Examples:

        beamsplat session merge monday tuesday --out both

        beamsplat session merge hall annex --out both --place 12.4,-3.1,90
    """
    from rich.progress import track

    from beamsplat.common.geometry.transforms import se2_to_se3
    from beamsplat.common.mapfiles.session import SessionFolder
    from beamsplat.tools.sessions.edit import merged, with_anchors
    from beamsplat.tools.sessions.merge import once

    (folder_a, a), (folder_b, b) = _open(first), _open(second)
    target = SessionFolder(out)
    if target.exists():
        raise UserError(f"{out}: holds a session already; choose another folder")
    both = all((folder.robot / ROBOT_MANIFEST).is_file() for folder in (folder_a, folder_b))
    slams = [load_slam(folder.robot) for folder in (folder_a, folder_b)] if both else []
    pose_a_b = _placed(place) if place else _found(first, second, slams)
    known = [*a["anchor_id"].tolist(), *(slams[0].pose_graph.submaps if slams else [])]
    offset = max([*known, -1]) + 2  # -1 is the second's odom origin
    arrays = merged(a, b, se2_to_se3(pose_a_b), offset)
    target.create()
    target.lock()
    try:
        if slams:
            from beamsplat.services.localization.lidar2d.merge import merge_into

            loops = merge_into(*slams, pose_a_b, offset)
            slams[0].save(target.robot)
            arrays = with_anchors(arrays, {id: se2_to_se3(pose) for id, pose in slams[0].anchors().items()})
            console.print(f"{loops} loop closures between the drives")
        held = set(arrays["keyframe_id"].tolist())
        for folder in (folder_a, folder_b):
            for id in held.intersection(folder.keyframe_ids()):
                target.write_keyframe(id, *folder.read_keyframe(id))
        before = arrays["store_params"].shape[1]
        arrays = once(
            target, arrays, offset, lambda views: track(views, "looking", console=console, transient=True)
        )
        _write(target, arrays)
    finally:
        target.unlock()
    left = arrays["store_params"].shape[1]
    print(
        f"{out}: {len(held)} keyframes, {left} Gaussians; {before - left} that both maps had are there once"
    )


@app.command()
def prune(
    session: SessionArgument,
    opacity: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Leave out Gaussians fainter than this")
    ] = 0.05,
    keyframes: Annotated[
        int | None, typer.Option(min=1, help="Keep so many keyframes, spread over the drive")
    ] = None,
) -> None:
    """Makes a session smaller: faint Gaussians, keyframes beyond a number, and their pictures on disk.

    Example: beamsplat session prune map --keyframes 400
    """
    from beamsplat.common.mapfiles.state import progress_of
    from beamsplat.tools.sessions.edit import pruned

    folder, arrays = _open(session)
    folder.lock()
    try:
        before = _bytes(session)
        out = pruned(arrays, opacity, keyframes)
        _write(folder, out)
        folder.remove_keyframes(progress_of(out)["forgotten"])
    finally:
        folder.unlock()
    gaussians = [a["store_params"].shape[1] for a in (arrays, out)]
    print(
        f"{session}: {gaussians[0]} -> {gaussians[1]} Gaussians, {len(arrays['keyframe_id'])} -> "
        f"{len(out['keyframe_id'])} keyframes, {before / 1e6:.1f} -> {_bytes(session) / 1e6:.1f} MB"
    )


def _bytes(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def _open(session: Path) -> tuple[Any, dict[str, Any]]:
    """(folder, arrays of its valid state).

    Raises:
        UserError: no session, or nothing saved in it.
    """
    from beamsplat.common.mapfiles.session import SessionFolder

    folder = SessionFolder(session)
    arrays = folder.read_state()
    if arrays is None:
        raise UserError(f"{session}: nothing has been saved in this session yet")
    newer = _newer(folder, arrays)
    if newer:
        console.print(f"[yellow]{session}: {newer} keyframes came after the checkpoint and are left out; "
                      "a mapper that resumes takes them in[/]")  # fmt: skip
    return folder, arrays


def _newer(folder: Any, arrays: dict[str, Any]) -> int:
    from beamsplat.common.mapfiles.state import progress_of

    known = {*arrays["extra_taken_id"].tolist(), *progress_of(arrays)["forgotten"]}
    return len(set(folder.keyframe_ids()) - known)


def _write(folder: Any, arrays: dict[str, Any]) -> None:
    from beamsplat.tools.sessions.edit import summary_of

    try:
        folder.write_state(arrays, summary_of(arrays))
        folder.remove_blocks(folder.block_numbers())  # all Gaussians are in the state now
    except OSError as error:
        raise UserError(
            f"{folder.path}: not written ({error.strerror}); the state before is whole"
        ) from error


def load_slam(path: Path) -> Any:
    """The lidar SLAM of a robot half.

    Raises:
        UserError: no state there, or not readable.
    """
    import numpy as np

    from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
    from beamsplat.services.localization.lidar2d.slam import LidarSlam
    from beamsplat.services.localization.lidar2d.state import MapStateError

    folder = path if (path / ROBOT_MANIFEST).is_file() else path / "state"
    try:
        # Where the lidar sits matters for new scans only.
        return LidarSlam.load(folder, LidarSlamSettings(), np.eye(4))
    except MapStateError as error:
        raise UserError(str(error)) from error


def _same_drive(session: Path, robot: Path, arrays: dict[str, Any], slam: Any) -> None:
    """Raises UserError where the map does not hang on that SLAM's: by their UUIDs, or where a state is from
    before it had one, because the keyframes were not taken while those scans were."""
    import numpy as np

    mine, its = _map_uuid(arrays), slam.pose_graph.uuid
    if mine and its and mine != its:
        raise UserError(
            f"{robot}: is the robot's half of map {its}, but {session} hangs on map {mine}: it is of another "
            "drive. Give the state that localization.save wrote in the session's own drive, or use `merge`"
        )

    scans_ns = np.array([node.stamp_ns for node in slam.pose_graph.nodes.values()])
    stamps_ns = arrays["extra_taken_stamp_ns"]
    if len(scans_ns) == 0 or len(stamps_ns) == 0:
        raise UserError(f"{robot if len(scans_ns) == 0 else session}: is empty; there is nothing to join")
    inside = (stamps_ns >= scans_ns.min() - _AROUND_NS) & (stamps_ns <= scans_ns.max() + _AROUND_NS)
    if inside.mean() < 0.9:
        raise UserError(
            f"{robot}: only {inside.mean():.0%} of the keyframes of {session} were taken during its scans: "
            "it is the half of another drive"
        )


def _placed(text: str) -> Any:
    import numpy as np

    try:
        x_m, y_m, yaw_deg = (float(word) for word in text.split(","))
    except ValueError as error:
        raise UserError(f"--place {text!r}: expected X,Y,DEG, for example 12.4,-3.1,90") from error
    return np.array([x_m, y_m, np.radians(yaw_deg)])


def _found(first: Path, second: Path, slams: list[Any]) -> Any:
    if not slams:
        raise UserError(
            f"{first} or {second} has no robot half to find the place with: join them first "
            "(`beamsplat session join`), or say where the second lies with --place X,Y,DEG"
        )
    from beamsplat.services.localization.lidar2d.merge import find_alignment

    alignment = find_alignment(*slams)
    if alignment is None:
        raise UserError(
            f"the scans of {second} find no place in {first} that enough of them agree on: "
            "say where it lies with --place X,Y,DEG"
        )
    console.print(f"{alignment.agreeing} of {alignment.queried} scans agree on where the second drive lies")
    return alignment.pose_a_b
