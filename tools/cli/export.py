"""`beamsplat export` and `beamsplat render`: write saved maps as files, images and videos."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import make_folder
from beamsplat.tools.cli.options import session_folder, writable

console = Console(stderr=True)
FORMATS = {
    "ply": "map.ply", "gltf": "map.glb", "spz": "map.spz", "points": "points.ply", "mesh": "mesh.ply",
    "nav2": "nav2",
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
_RESOLUTION_M = 0.05  # of nav2 grids
_MIN_FACES = 60  # of a connected component of the mesh; smaller ones are removed
_STATE_TIMEOUT_S = 120.0  # a mapper answers after its current keyframe, perhaps over a slow link
_GRID_TIMEOUT_S = 2.0  # for the tiles of the lidar grid that were published before
_VIEWS = 12  # viewpoints to measure the loss of merged detail


def export(
    session: SessionArgument,
    to: Annotated[str, typer.Option(help=f"One of {', '.join(FORMATS)}")],
    out: Annotated[
        Path | None,
        typer.Option(
            callback=writable,
            help="File (nav2: folder); default: named after the format, in the session, or here",
        ),
    ] = None,
    detail_m: Annotated[
        float, typer.Option(min=0.0, help="ply, gltf, spz: merge the Gaussians in each cell of this edge")
    ] = 0.0,
    cell_m: Annotated[float, typer.Option(min=0.002, help="points: distance between points")] = 0.02,
    voxel_m: Annotated[float, typer.Option(min=0.005, help="mesh: edge of a voxel")] = 0.04,
    low_m: Annotated[
        float, typer.Option(min=-10.0, max=10.0, help="nav2: lower end of the obstacle band above the floor")
    ] = 0.10,
    high_m: Annotated[
        float, typer.Option(min=-10.0, max=100.0, help="nav2: upper end of the obstacle band above the floor")
    ] = 1.50,
    threads: ThreadsOption = 2,
) -> None:
    """Write a map for other programs, also while the map is being built.

    ply: 3DGS layout. gltf: .glb with KHR_gaussian_splatting. spz: Niantic, small files. points: coloured
    points. mesh: coloured triangles. nav2: map.yaml (both layers), lidar.yaml, camera.yaml (obstacles outside
    the lidar plane). ply, points, mesh and nav2 have z up, gltf and spz y up; all are in metres.

    Examples:

        beamsplat export map --to spz

        beamsplat export map --to mesh --voxel-m 0.03 --out house.ply

        beamsplat export deploy/demo.toml --to spz --detail-m 0.04 --out far.spz
    """
    from beamsplat.common.mapfiles.state import store_of

    if to not in FORMATS:
        raise UserError(f"--to {to!r}: choose one of {', '.join(FORMATS)}")
    path = out or (Path() if _running(session) else session) / FORMATS[to]
    ending = Path(FORMATS[to]).suffix
    if path.suffix != ending:
        expected = f"a name ending in {ending}" if ending else "a folder name without an ending"
        raise UserError(f"--out {path}: expected {expected} for --to {to}")
    arrays, lidar = _open(session)
    store = store_of(arrays)
    try:
        make_folder(path.parent)
        if to in ("ply", "gltf", "spz"):
            text = _gaussians(path, to, store, arrays, detail_m, threads)
        elif to == "points":
            text = _points(path, store, arrays, cell_m, threads)
        elif to == "mesh":
            text = _mesh(path, store, arrays, voxel_m, threads)
        else:
            text = _nav2(path, lidar, store, arrays, (low_m, high_m), threads)
    except (OSError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path}: {reason(error)}") from error
    print(f"{path}: {text}")


def _running(session: Path) -> bool:
    return session.suffix == ".toml"


def _open(session: Path) -> tuple[dict[str, Any], Callable[[], Any]]:
    """Return (state arrays, function that returns the lidar OccupancyGrid or None), from disk or a mapper."""
    if _running(session):
        return _from_mapper(session)
    from beamsplat.common.mapfiles.session import SessionFolder
    from beamsplat.tools.cli.session import ROBOT_MANIFEST, load_slam

    folder = SessionFolder(session)
    arrays = folder.read_state()
    if arrays is None:
        raise UserError(f"{session}: nothing has been saved in this session yet")
    there = (folder.robot / ROBOT_MANIFEST).is_file()
    return arrays, lambda: load_slam(folder.robot).grid(_RESOLUTION_M) if there else None


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


def _gaussians(path: Path, to: str, store: Any, arrays: dict[str, Any], detail_m: float, threads: int) -> str:
    from beamsplat.common.mapfiles.detail import merge_by_cell

    whole = store.params[:, : store.count]
    params = merge_by_cell(whole, detail_m)
    _writer(to)(path, params)
    text = f"{params.shape[1]} Gaussians"
    if params is whole:
        return text
    psnr_db = _cost_db(store, params, arrays, threads)
    return f"{text} for {store.count}; {psnr_db:.1f} dB PSNR against the whole map from the keyframes"


def _cost_db(store: Any, params: Any, arrays: dict[str, Any], threads: int) -> float:
    """Return the mean PSNR (dB) of merged Gaussians against all Gaussians, from the keyframes' viewpoints."""
    import numpy as np

    from beamsplat.common.mapfiles.scores import psnr_db
    from beamsplat.common.mapfiles.state import keyframe_views
    from beamsplat.common.mapfiles.store import GaussianStore
    from beamsplat.common.mapfiles.video import render_path

    views = keyframe_views(arrays)
    views = views[:: -(-len(views) // _VIEWS) or 1]
    if not views:
        return float("nan")
    coarse, poses = GaussianStore(), [view.T_map_camera for view in views]
    coarse.add(params, 0)
    pairs = zip(*(render_path(s, views[0].camera, poses, threads) for s in (store, coarse)))
    return float(np.mean([psnr_db(a / 255.0, b / 255.0) for a, b in pairs]))


def _writer(to: str) -> Any:
    if to == "ply":
        from beamsplat.common.mapfiles.ply import write_gaussian_ply as write
    elif to == "gltf":
        from beamsplat.common.mapfiles.gltf import write_gltf as write
    else:
        from beamsplat.common.mapfiles.spz import write_spz as write
    return write


def _views(store: Any, arrays: dict[str, Any], threads: int) -> Any:
    """Yield the rendered depth of the map from all keyframes, with a progress bar."""
    from rich.progress import track

    from beamsplat.common.mapfiles.state import keyframe_views
    from beamsplat.common.mapfiles.surface import render_depth_views

    views = [(view.camera, view.T_map_camera) for view in keyframe_views(arrays)]
    if not views:
        raise UserError("the session has no keyframes: there is no viewpoint")
    rendered = render_depth_views(store, views, threads)
    return track(rendered, "rendering", len(views), console=console, transient=True)


def _points(path: Path, store: Any, arrays: dict[str, Any], cell_m: float, threads: int) -> str:
    from beamsplat.common.mapfiles.surface import surface_points, write_ply

    points, colours = surface_points(_views(store, arrays, threads), cell_m)
    write_ply(path, points, colours)
    return f"{len(points)} points"


def _mesh(path: Path, store: Any, arrays: dict[str, Any], voxel_m: float, threads: int) -> str:
    import numpy as np

    from beamsplat.common.mapfiles.mesh import TsdfVolume, remove_small_components, surface_nets
    from beamsplat.common.mapfiles.surface import points_of, write_ply

    views = list(_views(store, arrays, threads))
    corners = []
    for view in views:
        points = points_of(view)[0]
        if len(points):
            corners += [points.min(axis=0), points.max(axis=0)]
    if not corners:
        raise UserError("the map shows no surface from its keyframes")
    # A few pixels that look out of a window must not enlarge the volume.
    low, high = np.percentile(corners, 5.0, axis=0), np.percentile(corners, 95.0, axis=0)
    field = TsdfVolume.around(low, high, voxel_m)
    field.add(views)
    mesh = remove_small_components(surface_nets(field), _MIN_FACES)
    write_ply(path, mesh.vertices_m, mesh.colours, mesh.faces)
    return f"{len(mesh.faces)} triangles"


def _nav2(
    path: Path,
    lidar_grid: Callable[[], Any],
    store: Any,
    arrays: dict[str, Any],
    band_m: tuple[float, float],
    threads: int,
) -> str:
    from beamsplat.common.mapfiles.nav2 import camera_layer, combined, grid_around
    from beamsplat.common.mapfiles.surface import surface_points
    from beamsplat.services.localization.lidar2d.occupancy import FREE, OCCUPIED, OccupancyGrid, save_nav2

    points, _ = surface_points(_views(store, arrays, threads), 0.4 * _RESOLUTION_M)
    if len(points) == 0:
        raise UserError("the map shows no surface from its keyframes")
    lidar = lidar_grid()
    if lidar is None:
        origin, shape = grid_around(points, _RESOLUTION_M)
        camera = camera_layer(points, origin, shape, _RESOLUTION_M, *band_m)
        save_nav2(OccupancyGrid(camera, *origin, _RESOLUTION_M), path, "camera")
        save_nav2(OccupancyGrid(camera, *origin, _RESOLUTION_M), path)
        return "map.yaml, camera.yaml (no lidar layer: `beamsplat session join` adds the robot half)"
    origin, cell_m = (lidar.origin_x_m, lidar.origin_y_m), lidar.resolution_m
    camera = camera_layer(points, origin, lidar.values.shape, cell_m, *band_m)
    both = combined(lidar.values, camera, OCCUPIED, FREE)
    for name, values in (("map", both), ("lidar", lidar.values), ("camera", camera)):
        save_nav2(OccupancyGrid(values, *origin, cell_m), path, name)
    return "map.yaml, lidar.yaml, camera.yaml"


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
    bar = track(
        render_path(store, camera, poses, threads), "rendering", len(poses), console=console, transient=True
    )
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
