"""Points, meshes and nav2 maps of surfaces that are known."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from plyfile import PlyData

from beamsplat.common.geometry.transforms import make_transform, so3_exp
from beamsplat.common.mapfiles.mesh import TriangleMesh, TsdfVolume, remove_small_components, surface_nets
from beamsplat.common.mapfiles.nav2 import FREE, OCCUPIED, UNKNOWN, camera_layer, combined, grid_around
from beamsplat.common.mapfiles.surface import (
    RenderedDepth,
    flying_pixels,
    points_of,
    surface_points,
    write_ply,
)
from beamsplat.common.raster.camera import RasterCamera

CAMERA = RasterCamera(120.0, 120.0, 79.5, 59.5, 160, 120)
RED, BLUE = np.array([1.0, 0.0, 0.0], np.float32), np.array([0.0, 0.0, 1.0], np.float32)


def sphere_view(T_map_camera, behind_m=np.nan, radius_m=1.0):
    """Exact depth of a sphere at the map's origin, red above, blue below; `behind_m` is all the rest's."""
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    rays = np.stack(
        [(u - CAMERA.cx_px) / CAMERA.fx_px, (v - CAMERA.cy_px) / CAMERA.fy_px, np.ones(u.shape)], -1
    )
    rays = rays @ T_map_camera[:3, :3].T
    eye = T_map_camera[:3, 3]
    a, b, c = (rays**2).sum(-1), rays @ eye, eye @ eye - radius_m**2
    root = b**2 - a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, behind_m).astype(np.float32)
    depth[flying_pixels(depth)] = np.nan
    height = eye[2] + depth * rays[..., 2]
    return RenderedDepth(CAMERA, T_map_camera, np.where((height > 0)[..., None], RED, BLUE), depth)


def around(behind_m=np.nan, distance_m=3.0):
    """Views from all sides, above and below too."""
    out = []
    for turn in [so3_exp([0.0, angle, 0.0]) for angle in np.arange(8) * np.pi / 4] + [
        so3_exp([angle, 0.0, 0.0]) for angle in (np.pi / 2, -np.pi / 2)
    ]:
        out.append(sphere_view(make_transform(turn, turn @ [0.0, 0.0, -distance_m]), behind_m))
    return out


def fused(views, voxel_m=0.08):
    field = TsdfVolume.around(np.full(3, -1.0), np.full(3, 1.0), voxel_m)
    field.add(views)
    return field


def test_points_lie_on_the_surface_one_a_cell(tmp_path):
    points, colours = surface_points(around(), 0.05)
    write_ply(tmp_path / "points.ply", points, colours)
    v = PlyData.read(tmp_path / "points.ply")["vertex"]
    xyz = np.stack([v[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(xyz, points, atol=1e-3)
    np.testing.assert_array_equal(np.stack([v[c] for c in ("red", "green", "blue")], 1), colours)
    assert np.abs(np.linalg.norm(xyz, axis=1) - 1.0).max() < 0.01
    assert len(np.unique(np.floor(points / 0.05), axis=0)) > 0.97 * len(points)
    assert np.all(colours[points[:, 2] > 0.05] == [255, 0, 0])
    cloud = trimesh.load(tmp_path / "points.ply")
    np.testing.assert_allclose(cloud.vertices, points, atol=1e-3)


def test_a_sphere_seen_from_all_sides_is_watertight(tmp_path):
    mesh = remove_small_components(surface_nets(fused(around(behind_m=9.0))), 60)
    write_ply(tmp_path / "mesh.ply", mesh.vertices_m, mesh.colours, mesh.faces)
    read = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert read.is_watertight
    assert read.is_winding_consistent
    assert read.volume == pytest.approx(4.0 / 3.0 * np.pi, rel=0.04)  # positive: triangles face outwards
    assert np.abs(np.linalg.norm(read.vertices, axis=1) - 1.0).max() < 0.05
    colours = np.asarray(read.visual.vertex_colors)[:, :3]
    assert colours[read.vertices[:, 2] > 0.2][:, 0].min() > 200
    assert colours[read.vertices[:, 2] < -0.2][:, 2].min() > 200


def test_a_sphere_seen_from_one_side_is_open_only_where_it_was_not_seen():
    field = fused(around()[:1])
    mesh = surface_nets(field)
    read = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    assert not read.is_watertight
    edges = np.sort(read.edges, axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() <= 2
    rim = read.vertices[np.unique(unique[count == 1])]
    for cell in np.floor((rim - field.origin_m) / field.voxel_m).astype(int):
        low = np.maximum(cell - 1, 0)
        assert (field.weight[tuple(slice(a, b + 3) for a, b in zip(low, cell))] == 0).any()


def test_crumbs_go_and_large_fields_are_refused():
    whole = surface_nets(fused(around()))
    far = TriangleMesh(whole.vertices_m[:3] + 9.0, whole.colours[:3], np.array([[0, 1, 2]], np.int32))
    both = TriangleMesh(
        np.concatenate([whole.vertices_m, far.vertices_m]), np.concatenate([whole.colours, far.colours]),
        np.concatenate([whole.faces, far.faces + len(whole.vertices_m)]),
    )  # fmt: skip
    clean = remove_small_components(both, 10)
    assert len(clean.faces) == len(whole.faces)
    assert np.abs(clean.vertices_m).max() < 2.0
    with pytest.raises(ValueError, match=r"million voxels of 0\.01 m are too many; use 0\.\d+ m or more"):
        TsdfVolume.around(np.zeros(3), np.full(3, 30.0), 0.01)


def test_unknown_depth_gives_no_points():
    view = sphere_view(make_transform(np.eye(3), np.array([0.0, 0.0, -3.0])))
    empty = replace(view, depth_m=np.full_like(view.depth_m, np.nan))
    assert points_of(empty)[0].shape == (0, 3)
    assert len(surface_points([empty, view], 0.05)[0]) > 100


# --- nav2 ---


def slab(low, high, step=0.02):
    """Points on a grid that fills a box."""
    axes = [np.arange(a, b + 1e-9, step) for a, b in zip(low, high)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def test_the_camera_layer_has_what_the_lidars_plane_misses():
    """A floor, a table top at 0.7 m, a doorway's lintel at 2 m, a carpet's edge of 2 cm."""
    floor = slab((0.0, 0.0, 0.0), (4.0, 2.0, 0.0))
    table = slab((1.0, 0.5, 0.66), (1.6, 1.0, 0.72))
    lintel = slab((2.5, 0.0, 2.0), (2.6, 2.0, 2.2))
    carpet = slab((3.2, 0.5, 0.02), (3.6, 1.0, 0.02))
    layer = camera_layer(
        np.concatenate([floor, table, lintel, carpet]), (-0.5, -0.5), (60, 100), 0.05, 0.1, 1.5
    )

    def at(x, y):
        return layer[int((y + 0.5) / 0.05), int((x + 0.5) / 0.05)]

    assert at(1.3, 0.75) == OCCUPIED
    assert at(2.55, 1.0) == FREE
    assert at(3.4, 0.75) == FREE
    assert at(0.3, 0.3) == FREE
    assert at(-0.3, 0.3) == UNKNOWN
    assert (layer == OCCUPIED).sum() == pytest.approx(0.6 * 0.5 / 0.05**2, rel=0.2)


def test_layers_combine_as_a_robot_must_drive():
    lidar = np.array([[-1, 0, 100, 40, -1, 10]], np.int8)
    camera = np.array([[FREE, OCCUPIED, FREE, FREE, UNKNOWN, UNKNOWN]], np.int8)
    assert combined(lidar, camera, 65, 25).tolist() == [[0, 100, 100, 0, -1, 10]]


def test_a_grid_without_a_lidar_covers_the_points():
    points = np.array([[-1.02, 0.3, 0.0], [2.0, 4.9, 1.0]])
    (x, y), (rows, columns) = grid_around(points, 0.05)
    assert -1.13 < x < -1.02
    assert 0.19 < y < 0.3
    assert x + columns * 0.05 > 2.0
    assert y + rows * 0.05 > 4.9
