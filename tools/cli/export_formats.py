"""The formats of `beamsplat export`: from a saved state to files. The functions return what they wrote."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from rich.console import Console

from beamsplat.common.errors import UserError

console = Console(stderr=True)
SPLATS = ("ply", "compressed-ply", "gltf", "spz", "sog", "usd")
POINTS = ("points", "las", "e57")
DATASETS = ("nerfstudio", "colmap")
WITH_IMAGES = (*DATASETS, "textured-mesh")  # formats that need the images of a saved session
RESOLUTION_M = 0.05  # of nav2 grids
_MIN_FACES = 60  # of a connected component of the mesh; smaller ones are removed
_VIEWS = 12  # viewpoints to measure the loss of merged detail
_NO_SURFACE = "the map shows no surface from its keyframes"


@dataclass(frozen=True)
class ExportedMap:
    """The map to be exported."""

    session: Path  # folder of the session, or the deployment file of a running system
    arrays: dict[str, Any]  # of the mapper's state
    lidar_grid: Callable[[], Any]  # returns the lidar OccupancyGrid, or None
    threads: int  # of the rasterizer

    @cached_property
    def store(self) -> Any:
        """Return the Gaussians."""
        from beamsplat.common.mapfiles.state import store_of

        return store_of(self.arrays)


def write_splats(path: Path, to: str, map_: ExportedMap, detail_m: float) -> str:
    """Write the Gaussians in one of the formats `SPLATS`; those in a cell of `detail_m` are merged."""
    from beamsplat.common.mapfiles.detail import merge_by_cell

    store = map_.store
    whole = store.params[:, : store.count]
    params = merge_by_cell(whole, detail_m)
    with_harmonics = to == "ply" and params is whole
    _splat_writer(to)(path, store.with_harmonics() if with_harmonics else params)
    text = f"{params.shape[1]} Gaussians"
    if store.degree and not with_harmonics:
        text += " without their spherical harmonics (only `--to ply` in full detail has them)"
    if params is whole:
        return text
    psnr_db = _cost_db(map_, params)
    return f"{text} for {store.count}; {psnr_db:.1f} dB PSNR against the whole map from the keyframes"


def _cost_db(map_: ExportedMap, params: Any) -> float:
    """Return the mean PSNR (dB) of merged Gaussians against all Gaussians, from the keyframes' viewpoints."""
    import numpy as np

    from beamsplat.common.mapfiles.scores import psnr_db
    from beamsplat.common.mapfiles.state import keyframe_views
    from beamsplat.common.mapfiles.store import GaussianStore
    from beamsplat.common.mapfiles.video import render_path

    views = keyframe_views(map_.arrays)
    views = views[:: -(-len(views) // _VIEWS) or 1]
    if not views:
        return float("nan")
    coarse, poses = GaussianStore(), [view.T_map_camera for view in views]
    coarse.add(params, 0)
    pairs = zip(*(render_path(s, views[0].camera, poses, map_.threads) for s in (map_.store, coarse)))
    return float(np.mean([psnr_db(a / 255.0, b / 255.0) for a, b in pairs]))


def _splat_writer(to: str) -> Any:
    if to == "ply":
        from beamsplat.common.mapfiles.ply import write_gaussian_ply as write
    elif to == "compressed-ply":
        from beamsplat.common.mapfiles.compressed_ply import write_compressed_ply as write
    elif to == "gltf":
        from beamsplat.common.mapfiles.gltf import write_gltf as write
    elif to == "sog":
        from beamsplat.common.mapfiles.sog import write_sog as write
    elif to == "usd":
        from beamsplat.common.mapfiles.usd import write_usd as write
    else:
        from beamsplat.common.mapfiles.spz import write_spz as write
    return write


def _views(map_: ExportedMap) -> Any:
    """Yield the rendered depth of the map from all keyframes, with a progress bar."""
    from rich.progress import track

    from beamsplat.common.mapfiles.state import keyframe_views
    from beamsplat.common.mapfiles.surface import render_depth_views

    views = [(view.camera, view.T_map_camera) for view in keyframe_views(map_.arrays)]
    if not views:
        raise UserError("the session has no keyframes: there is no viewpoint")
    rendered = render_depth_views(map_.store, views, map_.threads)
    return track(rendered, "rendering", len(views), console=console, transient=True)


def write_points(path: Path, to: str, map_: ExportedMap, cell_m: float) -> str:
    """Write the surface as coloured points, one per cell of `cell_m`, in one of the formats `POINTS`."""
    from beamsplat.common.mapfiles.e57 import write_e57
    from beamsplat.common.mapfiles.las import write_las
    from beamsplat.common.mapfiles.surface import surface_points, write_ply

    points, colours = surface_points(_views(map_), cell_m)
    if len(points) == 0:
        raise UserError(_NO_SURFACE)
    write: dict[str, Callable[[Path, Any, Any], None]] = {
        "points": write_ply, "las": write_las, "e57": write_e57
    }  # fmt: skip
    write[to](path, points, colours)
    return f"{len(points)} points"


def _surface_box(views: list[Any]) -> tuple[Any, Any]:
    """Return the corners (smallest, largest coordinates) of a box around the surface in rendered views."""
    import numpy as np

    from beamsplat.common.mapfiles.surface import points_of

    corners = []
    for view in views:
        points = points_of(view)[0]
        if len(points):
            corners += [points.min(axis=0), points.max(axis=0)]
    if not corners:
        raise UserError(_NO_SURFACE)
    # A few pixels that look out of a window must not enlarge the volume.
    return np.percentile(corners, 5.0, axis=0), np.percentile(corners, 95.0, axis=0)


def _mesh_of(views: list[Any], voxel_m: float) -> Any:
    """Return the surface in rendered views as a TriangleMesh."""
    from beamsplat.common.mapfiles.mesh import TsdfVolume, remove_small_components, surface_nets

    field = TsdfVolume.around(*_surface_box(views), voxel_m)
    field.add(views)
    return remove_small_components(surface_nets(field), _MIN_FACES)


def write_mesh(path: Path, map_: ExportedMap, voxel_m: float) -> str:
    """Write the surface as a coloured mesh (PLY)."""
    from beamsplat.common.mapfiles.surface import write_ply

    mesh = _mesh_of(list(_views(map_)), voxel_m)
    write_ply(path, mesh.vertices_m, mesh.colours, mesh.faces)
    return f"{len(mesh.faces)} triangles"


def write_textured_mesh(path: Path, map_: ExportedMap, voxel_m: float) -> str:
    """Write the surface as a mesh with a texture from the images of the keyframes (glTF)."""
    from beamsplat.common.mapfiles import textured_mesh
    from beamsplat.common.mapfiles.session import SessionFolder
    from beamsplat.common.mapfiles.texture import choose_views
    from beamsplat.tools.sessions.frames import SessionFrames

    frames = SessionFrames(SessionFolder(map_.session), map_.arrays)
    rendered = list(_views(map_))
    mesh = _mesh_of(rendered, voxel_m)
    keyframes, views = [], []
    for keyframe, view in zip(frames.views, rendered):
        frame = frames.frame(keyframe)
        if frame is not None:
            keyframes.append(keyframe)
            views.append(textured_mesh.without_masked(view, frame.mask))
    choice = choose_views(mesh, views, [keyframe.camera for keyframe in keyframes])

    def image(number: int) -> Any:
        frame = frames.frame(keyframes[number])
        if frame is None:
            raise UserError(f"{map_.session}: {frames.lost[-1]}")
        return frames.as_mapped(frame)

    images = textured_mesh.ImageOf(keyframes, image)
    width, height = textured_mesh.write_textured_mesh(path, mesh, choice, images)
    _report_left_out(frames.lost)
    used = len(set(choice.view[choice.view >= 0].tolist()))
    return (
        f"{len(mesh.faces)} triangles, {(choice.view >= 0).mean():.0%} of them with the texture "
        f"({width} x {height} px) of {used} images"
    )


def _report_left_out(lost: list[str]) -> None:
    for fault in lost:
        console.print(f"left out: {fault}", style="yellow", markup=False, soft_wrap=True)


def write_octomap(path: Path, map_: ExportedMap, voxel_m: float) -> str:
    """Write occupied and free voxels as an OctoMap tree (.bt)."""
    from beamsplat.common.mapfiles import octomap

    views = list(_views(map_))
    volume = octomap.volume_for_octomap(*_surface_box(views), voxel_m)
    volume.add(views)
    keys, states = octomap.occupancy_of(volume, views)
    octomap.write_octomap(path, keys, states, voxel_m)
    occupied = int((states == octomap.OCCUPIED).sum())
    return f"{occupied} occupied and {len(states) - occupied} free voxels of {voxel_m:g} m"


def write_nav2(path: Path, map_: ExportedMap, band_m: tuple[float, float]) -> str:
    """Write the lidar grid, the camera layer of obstacles within `band_m`, and both combined, for nav2."""
    from beamsplat.common.mapfiles.nav2 import camera_layer, combined, grid_around
    from beamsplat.common.mapfiles.surface import surface_points
    from beamsplat.services.localization.lidar2d.occupancy import FREE, OCCUPIED, OccupancyGrid, save_nav2

    points, _ = surface_points(_views(map_), 0.4 * RESOLUTION_M)
    if len(points) == 0:
        raise UserError(_NO_SURFACE)
    lidar = map_.lidar_grid()
    if lidar is None:
        origin, shape = grid_around(points, RESOLUTION_M)
        camera = camera_layer(points, origin, shape, RESOLUTION_M, *band_m)
        save_nav2(OccupancyGrid(camera, *origin, RESOLUTION_M), path, "camera")
        save_nav2(OccupancyGrid(camera, *origin, RESOLUTION_M), path)
        return "map.yaml, camera.yaml (no lidar layer: `beamsplat session join` adds the robot half)"
    origin, cell_m = (lidar.origin_x_m, lidar.origin_y_m), lidar.resolution_m
    camera = camera_layer(points, origin, lidar.values.shape, cell_m, *band_m)
    both = combined(lidar.values, camera, OCCUPIED, FREE)
    for name, values in (("map", both), ("lidar", lidar.values), ("camera", camera)):
        save_nav2(OccupancyGrid(values, *origin, cell_m), path, name)
    return "map.yaml, lidar.yaml, camera.yaml"


def write_dataset(path: Path, to: str, map_: ExportedMap, cell_m: float, text: bool) -> str:
    """Write the keyframes as a data set for nerfstudio or COLMAP: the whole folder, or nothing.

    Raises:
        UserError: `path` exists already, or no keyframe can be read.
    """
    from rich.progress import track

    from beamsplat.common.mapfiles.colmap import write_model
    from beamsplat.common.mapfiles.dataset import write_frames
    from beamsplat.common.mapfiles.nerfstudio import write_transforms
    from beamsplat.common.mapfiles.session import SessionFolder
    from beamsplat.tools.sessions.frames import SessionFrames

    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise UserError(f"--out {path}: exists already; remove it, or choose another folder")
    frames = SessionFrames(SessionFolder(map_.session), map_.arrays)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.mkdir(parents=True)
    try:
        bar = track(frames, "keyframes", len(frames), console=console, transient=True)
        dataset = write_frames(partial, bar, cell_m)
        if not dataset.entries:
            why = f"; {frames.lost[0]}" if frames.lost else ""
            raise UserError(f"{map_.session}: has no keyframe with an image{why}")
        if to == "colmap":
            write_model(partial / "sparse" / "0", dataset, text)
        else:
            write_transforms(partial, dataset)
        os.replace(partial, path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    _report_left_out(frames.lost)
    return f"{len(dataset.entries)} images with depth, {len(dataset.points.sigma_m)} lidar points"
