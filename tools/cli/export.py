"""`beamsplat export` and `beamsplat render`: write saved maps as files, images and videos."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import make_folder
from beamsplat.tools.cli import export_formats as formats
from beamsplat.tools.cli.options import session_folder, writable

FORMATS = {
    "ply": "map.ply", "compressed-ply": "map.compressed.ply", "gltf": "map.glb", "spz": "map.spz",
    "sog": "map.sog", "usd": "map.usda", "points": "points.ply", "las": "points.las", "e57": "points.e57",
    "mesh": "mesh.ply", "textured-mesh": "mesh.glb", "octomap": "map.bt", "nav2": "nav2",
    "nerfstudio": "nerfstudio", "colmap": "colmap",
}  # fmt: skip
SessionArgument = Annotated[
    Path,
    typer.Argument(
        callback=session_folder,
        help="Folder written by `mapping.session = DIR`; or the deployment file (.toml) of a running system: "
        "its mapper then sends the map",
    ),
]
ThreadsOption = Annotated[int, typer.Option(min=1, help="Threads of the rasterizer")]
_STATE_TIMEOUT_S = 120.0  # a mapper answers after its current keyframe, perhaps over a slow link
_GRID_TIMEOUT_S = 2.0  # for the tiles of the lidar grid that were published before


def export(
    session: SessionArgument,
    to: Annotated[str, typer.Option(help=f"One of {', '.join(FORMATS)}")],
    out: Annotated[
        Path | None,
        typer.Option(
            callback=writable,
            help="File, or folder (nav2, nerfstudio, colmap); default: named after the format, in the "
            "session, or here",
        ),
    ] = None,
    detail_m: Annotated[
        float, typer.Option(min=0.0, help="Splats: merge the Gaussians in each cell of this edge")
    ] = 0.0,
    cell_m: Annotated[
        float,
        typer.Option(
            min=0.002,
            help="points, las, e57: distance between points; nerfstudio, colmap: between lidar points",
        ),
    ] = 0.02,
    voxel_m: Annotated[
        float, typer.Option(min=0.005, help="mesh, textured-mesh, octomap: edge of a voxel")
    ] = 0.04,
    low_m: Annotated[
        float, typer.Option(min=-10.0, max=10.0, help="nav2: lower end of the obstacle band above the floor")
    ] = 0.10,
    high_m: Annotated[
        float, typer.Option(min=-10.0, max=100.0, help="nav2: upper end of the obstacle band above the floor")
    ] = 1.50,
    text: Annotated[bool, typer.Option("--text", help="colmap: text files instead of binary ones")] = False,
    threads: ThreadsOption = 2,
) -> None:
    """Write a map for other programs, also while the map is being built.

    Splats: ply (3DGS layout), gltf (.glb with KHR_gaussian_splatting), spz (Niantic, small), sog and
    compressed-ply (PlayCanvas, SuperSplat; small), usd (OpenUSD 26.03 and newer; text). points, las, e57:
    coloured points. mesh: triangles with coloured vertices. textured-mesh: triangles with a texture cut out
    of the keyframes' images (.glb). octomap: occupied and free voxels. nav2: map.yaml (both layers),
    lidar.yaml, camera.yaml (obstacles outside the lidar plane). nerfstudio, colmap: images, depth maps, poses
    and lidar points of the keyframes; these two and textured-mesh need a saved session. All are in metres. z
    is up; gltf, spz and textured-mesh: y up; sog and compressed-ply: y down, which their viewers turn
    upright.

    Examples:

        beamsplat export map --to spz

        beamsplat export map --to mesh --voxel-m 0.03 --out house.ply

        beamsplat export map --to nerfstudio --out house

        beamsplat export deploy/demo.toml --to spz --detail-m 0.04 --out far.spz
    """
    path = _target(session, to, out)
    map_ = formats.ExportedMap(session, *_open(session), threads)
    try:
        make_folder(path.parent)
        if to in formats.SPLATS:
            written = formats.write_splats(path, to, map_, detail_m)
        elif to in formats.POINTS:
            written = formats.write_points(path, to, map_, cell_m)
        elif to == "mesh":
            written = formats.write_mesh(path, map_, voxel_m)
        elif to == "textured-mesh":
            written = formats.write_textured_mesh(path, map_, voxel_m)
        elif to == "octomap":
            written = formats.write_octomap(path, map_, voxel_m)
        elif to == "nav2":
            written = formats.write_nav2(path, map_, (low_m, high_m))
        else:
            written = formats.write_dataset(path, to, map_, cell_m, text)
    except (OSError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path}: {reason(error)}") from error
    print(f"{path}: {written}")


def _target(session: Path, to: str, out: Path | None) -> Path:
    """Return the file or folder to be written.

    Raises:
        UserError: no such format, it needs a saved session, or `out` has a wrong ending.
    """
    if to not in FORMATS:
        raise UserError(f"--to {to!r}: choose one of {', '.join(FORMATS)}")
    if to in formats.WITH_IMAGES and _running(session):
        raise UserError(
            f"--to {to}: needs the images of a saved session, and {session} is a running system: give the "
            "folder of its option `mapping.session`"
        )
    path = out or (Path() if _running(session) else session) / FORMATS[to]
    ending = Path(FORMATS[to]).suffix
    if path.suffix != ending:
        expected = f"a name ending in {ending}" if ending else "a folder name without an ending"
        raise UserError(f"--out {path}: expected {expected} for --to {to}")
    return path


def _running(session: Path) -> bool:
    return session.suffix == ".toml"


def _open(session: Path) -> tuple[dict[str, Any], Callable[[], Any]]:
    """Return (state arrays, function that returns the lidar OccupancyGrid or None), from disk or a mapper."""
    if _running(session):
        return _from_mapper(session)
    from beamsplat.common.mapfiles.session import SessionFolder
    from beamsplat.tools.sessions.opened import ROBOT_MANIFEST, load_slam

    folder = SessionFolder(session)
    arrays = folder.read_state()
    if arrays is None:
        raise UserError(f"{session}: nothing has been saved in this session yet")
    there = (folder.robot / ROBOT_MANIFEST).is_file()
    return arrays, lambda: load_slam(folder.robot).grid(formats.RESOLUTION_M) if there else None


def _from_mapper(file: Path) -> tuple[dict[str, Any], Callable[[], Any]]:
    """Return the same as `_open`, from a running mapper and localization."""
    from beamsplat.common.config.deployment import load_deployment
    from beamsplat.common.messages import MapState
    from beamsplat.common.security.logins import OPERATOR, login_of
    from beamsplat.common.zenoh.bus import open_session
    from beamsplat.common.zenoh.queries import ask
    from beamsplat.services.mapping.messages import joined_state

    deployment = load_deployment(file)
    login = login_of(deployment.security, OPERATOR)
    with open_session(deployment.router.listen, 2.0, login=login) as session:
        answers = ask(session, deployment.robot, "mapping", "state", {}, _STATE_TIMEOUT_S)
        arrays = joined_state([answer for answer in answers if isinstance(answer, MapState)])
        grid = _published_grid(session, deployment.robot)
    return arrays, lambda: grid


def _published_grid(session: Any, robot: str) -> Any:
    """Return the lidar OccupancyGrid that localization has published; None if there is none."""
    import queue
    import time

    import zenoh

    from beamsplat.common.mapfiles.grid_tiles import GridSource, TiledGrid
    from beamsplat.common.messages import GridTile
    from beamsplat.common.messages.header import DecodeError
    from beamsplat.common.topics import topic
    from beamsplat.common.zenoh.bus import key
    from beamsplat.common.zenoh.streams import declare_subscription, decode_sample
    from beamsplat.services.localization.lidar2d.occupancy import OccupancyGrid

    row = topic("localization/grid")
    received: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    _kept = declare_subscription(session, key(robot, row.name), row, "every", received.put)
    grid, until = TiledGrid(), time.monotonic() + _GRID_TIMEOUT_S
    try:
        while (left_s := until - time.monotonic()) > 0.0:
            tile = decode_sample(received.get(timeout=left_s), row).message
            assert isinstance(tile, GridTile)  # the row's message type
            source = GridSource(tile.map_uuid, tile.since_ns, tile.resolution_m, tile.size)
            grid.add(source, tile.row, tile.column, tile.packed.tobytes())
    except queue.Empty:
        pass
    except (DecodeError, ValueError) as error:
        raise UserError(f"localization/grid of the running system cannot be decoded: {error}") from error
    if grid.source is None:
        return None
    x_m, y_m = (float(v) for v in grid.origin_m())
    return OccupancyGrid(grid.assembled(), x_m, y_m, grid.source.resolution_m)


def render(
    session: SessionArgument,
    path: Annotated[str, typer.Option(help="orbit, drive, or a TUM file of body poses in the map")],
    out: Annotated[Path, typer.Option(callback=writable, help="NAME.mp4, or NAME.png for images")],
    seconds: Annotated[float, typer.Option(min=0.1, help="Length of the video")] = 10.0,
    fps: Annotated[float, typer.Option(min=1.0, help="Images per second")] = 30.0,
    width: Annotated[int, typer.Option(min=0, help="Image width in pixels; 0: that of the keyframes")] = 0,
    threads: ThreadsOption = 2,
) -> None:
    """Render a map along a camera path: around the map, along its own drive, or along a path from a file.

    Examples:

        beamsplat render map --path drive --out drive.mp4

        beamsplat render map --path orbit --seconds 1 --fps 8 --out round.png
    """
    from rich.progress import track

    from beamsplat.common.mapfiles.state import keyframe_views, store_of
    from beamsplat.common.mapfiles.video import render_path, write_video

    arrays, _ = _open(session)
    views, store = keyframe_views(arrays), store_of(arrays)
    if not views:
        raise UserError(f"{session}: has no keyframes, so the camera is unknown")
    frames = max(round(seconds * fps), 1)
    camera = views[0].camera
    if width:
        camera = camera.resized(width, round(width * camera.height_px / camera.width_px))
    poses = _poses(path, store, arrays, views, frames)
    images = render_path(store, camera, poses, threads)
    bar = track(images, "rendering", len(poses), console=formats.console, transient=True)
    written = write_video(out, bar, fps, len(poses))
    print(f"{written[0]}: {len(poses)} images of {camera.width_px}x{camera.height_px}")


def _poses(path: str, store: Any, arrays: dict[str, Any], views: list[Any], frames: int) -> Any:
    import numpy as np

    from beamsplat.common.geometry.trajectory import read_tum
    from beamsplat.common.geometry.transforms import inverse
    from beamsplat.common.mapfiles.video import interpolate_path, orbit_poses, trajectory_poses

    if path == "orbit":
        return orbit_poses(store, float(np.median([view.T_map_camera[2, 3] for view in views])), frames)
    if path == "drive":
        return interpolate_path([view.T_map_camera for view in views], frames)
    trajectory = read_tum(Path(path))
    if len(trajectory) == 0:
        raise UserError(f"{path}: has no poses")
    return trajectory_poses(trajectory, inverse(arrays["extra_taken_T_camera_body"][0]), frames)
