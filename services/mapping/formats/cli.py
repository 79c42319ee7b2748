"""`beamsplat export` and `beamsplat render`: saved maps as files that others open, and as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from common.errors import UserError

console = Console(stderr=True)
FORMATS = {
    "ply": "map.ply", "gltf": "map.glb", "spz": "map.spz", "points": "points.ply", "mesh": "mesh.ply",
    "nav2": "nav2",
}  # fmt: skip
SessionArgument = Annotated[Path, typer.Argument(help="Folder written by `mapping.session = DIR`")]
ThreadsOption = Annotated[int, typer.Option(min=1, help="Threads of the rasterizer")]
_RESOLUTION_M = 0.05
_LEAST_FACES = 60  # of a piece of mesh: less is a crumb


def export(
    session: SessionArgument,
    to: Annotated[str, typer.Option(help=f"One of {', '.join(FORMATS)}")],
    out: Annotated[
        Path | None, typer.Option(help="File (nav2: folder); default: named after the format, in the session")
    ] = None,
    cell_m: Annotated[float, typer.Option(min=0.002, help="points: between points")] = 0.02,
    voxel_m: Annotated[float, typer.Option(min=0.005, help="mesh: finest detail")] = 0.04,
    low_m: Annotated[float, typer.Option(help="nav2: what stands higher than this is in the way")] = 0.10,
    high_m: Annotated[float, typer.Option(help="nav2: what hangs higher than this is not")] = 1.50,
    threads: ThreadsOption = 2,
) -> None:
    """Writes a saved map for other programs; at any time, also while a mapper saves to it.

    ply: 3DGS layout. gltf: .glb with KHR_gaussian_splatting. spz: Niantic's, small. points: coloured points.
    mesh: coloured triangles. nav2: map.yaml (both), lidar.yaml, camera.yaml (what the lidar's plane misses).
    ply, points, mesh and nav2 have z up, gltf and spz y up; all are in metres.

    Examples:

        beamsplat export map --to spz

        beamsplat export map --to mesh --voxel-m 0.03 --out house.ply
    """
    from services.mapping.session.state import store_of

    if to not in FORMATS:
        raise UserError(f"--to {to!r}: there are {', '.join(FORMATS)}")
    folder, arrays = _open(session)
    store, path = store_of(arrays), out or session / FORMATS[to]
    params = store.params[:, : store.count]
    if to == "gltf" and path.suffix != ".glb":
        raise UserError(f"--out {path}: glTF is written in its binary form; expected a name ending in .glb")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if to in ("ply", "gltf", "spz"):
            _writer(to)(path, params)
            text = f"{store.count} Gaussians"
        elif to == "points":
            text = _points(path, store, arrays, cell_m, threads)
        elif to == "mesh":
            text = _mesh(path, store, arrays, voxel_m, threads)
        else:
            text = _nav2(path, folder, store, arrays, (low_m, high_m), threads)
    except (OSError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path}: {error}") from error
    print(f"{path}: {text}")


def _open(session: Path) -> tuple[Any, dict[str, Any]]:
    from services.mapping.session.folder import SessionFolder

    folder = SessionFolder(session)
    arrays = folder.read_state()
    if arrays is None:
        raise UserError(f"{session}: nothing has been saved in this session yet")
    return folder, arrays


def _writer(to: str) -> Any:
    if to == "ply":
        from services.mapping.export import write_gaussian_ply as write
    elif to == "gltf":
        from services.mapping.formats.gltf import write_gltf as write
    else:
        from services.mapping.formats.spz import write_spz as write
    return write


def _views(store: Any, arrays: dict[str, Any], threads: int) -> Any:
    """The map's rendered depth from all keyframes, with a bar."""
    from rich.progress import track

    from services.mapping.formats.surface import rendered_views
    from services.mapping.session.state import views_of

    views = [(view.camera, view.T_map_camera) for view in views_of(arrays)]
    if not views:
        raise UserError("the session has no keyframes to look from")
    rendered = rendered_views(store, views, threads)
    return track(rendered, "looking", len(views), console=console, transient=True)


def _points(path: Path, store: Any, arrays: dict[str, Any], cell_m: float, threads: int) -> str:
    from services.mapping.formats.surface import surface_points, write_ply

    points, colours = surface_points(_views(store, arrays, threads), cell_m)
    write_ply(path, points, colours)
    return f"{len(points)} points"


def _mesh(path: Path, store: Any, arrays: dict[str, Any], voxel_m: float, threads: int) -> str:
    import numpy as np

    from services.mapping.formats.mesh import DistanceField, surface_nets, without_crumbs
    from services.mapping.formats.surface import points_of, write_ply

    views = list(_views(store, arrays, threads))
    corners = []
    for view in views:
        points = points_of(view)[0]
        if len(points):
            corners += [points.min(axis=0), points.max(axis=0)]
    if not corners:
        raise UserError("the map shows no surface from its keyframes")
    # The rare pixel that looks out of a window must not make the field large.
    low, high = np.percentile(corners, 5.0, axis=0), np.percentile(corners, 95.0, axis=0)
    field = DistanceField.around(low, high, voxel_m)
    field.add(views)
    mesh = without_crumbs(surface_nets(field), _LEAST_FACES)
    write_ply(path, mesh.vertices_m, mesh.colours, mesh.faces)
    return f"{len(mesh.faces)} triangles"


def _nav2(
    path: Path, folder: Any, store: Any, arrays: dict[str, Any], band_m: tuple[float, float], threads: int
) -> str:
    from services.localization.lidar2d.occupancy import FREE, OCCUPIED, OccupancyGrid, save_nav2
    from services.mapping.formats.nav2 import camera_layer, combined, grid_around
    from services.mapping.formats.surface import surface_points
    from services.mapping.session.cli import ROBOT_MANIFEST, load_slam

    points, _ = surface_points(_views(store, arrays, threads), 0.4 * _RESOLUTION_M)
    if len(points) == 0:
        raise UserError("the map shows no surface from its keyframes")
    lidar = load_slam(folder.robot).grid(_RESOLUTION_M) if (folder.robot / ROBOT_MANIFEST).is_file() else None
    if lidar is None:
        origin, shape = grid_around(points, _RESOLUTION_M)
        camera = camera_layer(points, origin, shape, _RESOLUTION_M, *band_m)
        save_nav2(OccupancyGrid(camera, *origin, _RESOLUTION_M), path, "camera")
        save_nav2(OccupancyGrid(camera, *origin, _RESOLUTION_M), path)
        return "map.yaml, camera.yaml (no lidar layer: `beamsplat session join` puts the robot's half in)"
    origin = (lidar.origin_x_m, lidar.origin_y_m)
    camera = camera_layer(points, origin, lidar.values.shape, _RESOLUTION_M, *band_m)
    both = combined(lidar.values, camera, OCCUPIED, FREE)
    for name, values in (("map", both), ("lidar", lidar.values), ("camera", camera)):
        save_nav2(OccupancyGrid(values, *origin, _RESOLUTION_M), path, name)
    return "map.yaml, lidar.yaml, camera.yaml"


def render(
    session: SessionArgument,
    path: Annotated[str, typer.Option(help="orbit, drive, or a TUM file of body poses in the map")],
    out: Annotated[Path, typer.Option(help="NAME.mp4, or NAME.png for pictures")],
    seconds: Annotated[float, typer.Option(min=0.1, help="How long the video is")] = 10.0,
    fps: Annotated[float, typer.Option(min=1.0, help="Pictures a second")] = 30.0,
    width: Annotated[int, typer.Option(min=0, help="Pixels; 0: as the keyframes")] = 0,
    threads: ThreadsOption = 2,
) -> None:
    """Films a saved map: round it, along its own drive, or along a path of yours.

    Examples:

        beamsplat render map --path drive --out drive.mp4

        beamsplat render map --path orbit --seconds 1 --fps 8 --out round.png
    """
    from rich.progress import track

    from services.mapping.formats.film import pictures, write_film
    from services.mapping.session.state import store_of, views_of

    _, arrays = _open(session)
    views, store = views_of(arrays), store_of(arrays)
    if not views:
        raise UserError(f"{session}: has no keyframes, so no camera to film with")
    frames = max(round(seconds * fps), 1)
    camera = views[0].camera
    if width:
        camera = camera.resized(width, round(width * camera.height_px / camera.width_px))
    poses = _poses(path, store, arrays, views, frames)
    bar = track(
        pictures(store, camera, poses, threads), "rendering", len(poses), console=console, transient=True
    )
    written = write_film(out, bar, fps, len(poses))
    print(f"{written[0]}: {len(poses)} pictures of {camera.width_px}x{camera.height_px}")


def _poses(path: str, store: Any, arrays: dict[str, Any], views: list[Any], frames: int) -> Any:
    import numpy as np

    from common.geometry import inverse
    from common.trajectory import read_tum
    from services.mapping.formats.film import along, drive, orbit

    if path == "orbit":
        return orbit(store, float(np.median([view.T_map_camera[2, 3] for view in views])), frames)
    if path == "drive":
        return drive([view.T_map_camera for view in views], frames)
    trajectory = read_tum(Path(path))
    if len(trajectory) == 0:
        raise UserError(f"{path}: has no poses")
    return along(trajectory, inverse(arrays["extra_taken_T_camera_body"][0]), frames)
