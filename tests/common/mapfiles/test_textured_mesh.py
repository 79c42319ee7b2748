"""Textured meshes, read by trimesh: each point of the surface has the colour that the images show there."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from beamsplat.common.mapfiles.mesh import TriangleMesh
from beamsplat.common.mapfiles.state import KeyframeView
from beamsplat.common.mapfiles.surface import RenderedDepth
from beamsplat.common.mapfiles.texture import choose_views, project
from beamsplat.common.mapfiles.textured_mesh import ImageOf, without_masked, write_textured_mesh
from beamsplat.common.mapfiles.y_up import R_yup_map
from beamsplat.common.raster.camera import RasterCamera

CAMERA = RasterCamera(220.0, 220.0, 159.5, 119.5, 320, 240)


def colour_at(points):
    """The wall's colour at points [N, 3], smooth, RGB in [0, 1]."""
    y, z = points[..., 1], points[..., 2]
    return np.stack([0.5 + 0.4 * np.sin(2.0 * y), 0.5 + 0.4 * np.cos(1.5 * z), 0.3 + 0.1 * y / 2.0], axis=-1)


def wall():
    """A wall at x = 3 of 4 x 2.4 m in 10 cm squares; its triangles face the origin."""
    y, z = np.meshgrid(np.linspace(-2.0, 2.0, 41), np.linspace(0.0, 2.4, 25), indexing="ij")
    vertices = np.stack([np.full(y.size, 3.0), y.ravel(), z.ravel()], axis=1)
    i, j = np.meshgrid(np.arange(40), np.arange(24), indexing="ij")
    a = (i * 25 + j).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 26], 1), np.stack([a, a + 26, a + 25], 1)])
    return TriangleMesh(vertices, np.full((len(vertices), 3), 120, np.uint8), faces.astype(np.int32))


def looking_along_x(y, z=1.2):
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T[:3, 3] = 0.0, y, z
    return T


def view_of(T_map_camera, keep=None):
    """(keyframe, its image of the endless wall, its rendered depth)."""
    v, u = np.mgrid[0:240, 0:320]
    rays = np.stack([(u - 159.5) / 220.0, (v - 119.5) / 220.0, np.ones(u.shape)], axis=-1)
    points = 3.0 * rays @ T_map_camera[:3, :3].T + T_map_camera[:3, 3]
    image = (np.clip(colour_at(points), 0, 1) * 255 + 0.5).astype(np.uint8)
    half = CAMERA.resized(160, 120)
    depth = RenderedDepth(half, T_map_camera, np.zeros((120, 160, 3)), np.full((120, 160), 3.0, np.float32))
    return image, depth if keep is None else without_masked(depth, keep)


@pytest.fixture(scope="module")
def drive():
    """Three images of the wall; the second has a person in its right half."""
    poses = [looking_along_x(y) for y in (-0.8, 0.0, 0.8)]
    mask = np.ones((240, 320), bool)
    mask[:, 160:] = False
    shots = [view_of(T, mask if i == 1 else None) for i, T in enumerate(poses)]
    shots[1][0][:, 160:] = 0
    return SimpleNamespace(
        keyframes=[KeyframeView(i, CAMERA, T) for i, T in enumerate(poses)],
        images=[image for image, _ in shots], views=[view for _, view in shots],
    )  # fmt: skip


def texture_colours(path):
    """(points [N, 3] in the map frame, their colours [N, 3] in [0, 1]) at the centres of the triangles."""
    scene = trimesh.load_scene(path)
    (mesh,) = scene.dump()
    uv = mesh.visual.uv[mesh.faces].mean(axis=1)
    picture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB")) / 255.0
    column = uv[:, 0] * picture.shape[1] - 0.5
    row = (1.0 - uv[:, 1]) * picture.shape[0] - 0.5  # trimesh turns v up
    colours = picture[np.round(row).astype(int), np.round(column).astype(int)]
    return mesh.vertices[mesh.faces].mean(axis=1) @ R_yup_map, colours


def test_each_triangle_has_the_colour_of_the_wall(drive, tmp_path):
    mesh = wall()
    choice = choose_views(mesh, drive.views, [k.camera for k in drive.keyframes])
    images = ImageOf(drive.keyframes, drive.images.__getitem__)
    write_textured_mesh(tmp_path / "wall.glb", mesh, choice, images)
    points, colours = texture_colours(tmp_path / "wall.glb")
    np.testing.assert_allclose(points[:, 0], 3.0, atol=1e-6)
    centres = mesh.vertices_m[mesh.faces].mean(axis=1)
    np.testing.assert_allclose(points, centres, atol=1e-6)
    textured = choice.view >= 0
    assert textured.mean() > 0.75
    off = np.abs(colours - colour_at(points))[textured]
    assert off.max() < 0.05
    assert np.median(off) < 0.01
    np.testing.assert_allclose(colours[~textured], 120 / 255.0, atol=0.03)


def test_patches_are_few_and_avoid_what_is_masked_or_hidden(drive):
    mesh = wall()
    choice = choose_views(mesh, drive.views, [k.camera for k in drive.keyframes])
    uvz = project(mesh.vertices_m[mesh.faces].mean(axis=1), CAMERA, drive.keyframes[1].T_map_camera)
    assert not ((choice.view == 1) & (uvz[:, 0] > 161)).any()
    assert choice.patch.max() + 1 <= 6
    hidden = [view_of(looking_along_x(0.0))[1]]
    hidden[0].depth_m[:, :80] = 2.0  # something stands in front of the left half of the wall
    alone = choose_views(mesh, hidden, [CAMERA])
    assert not (alone.view[uvz[:, 0] < 157] >= 0).any()
    assert (alone.view[(uvz[:, 0] > 163) & (uvz[:, 0] < 310) & (np.abs(uvz[:, 1] - 120) < 80)] == 0).all()


def test_a_mesh_that_no_image_sees_has_the_colours_of_its_vertices(tmp_path):
    mesh = wall()
    images = ImageOf([], [].__getitem__)
    write_textured_mesh(tmp_path / "wall.glb", mesh, choose_views(mesh, [], []), images)
    _, colours = texture_colours(tmp_path / "wall.glb")
    np.testing.assert_allclose(colours, 120 / 255.0, atol=0.03)
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.int32))
    choice = choose_views(empty, [], [])
    with pytest.raises(ValueError, match="no triangles"):
        write_textured_mesh(tmp_path / "none.glb", empty, choice, images)


def test_a_large_mesh_gets_a_smaller_texture_and_the_same_colours(drive, tmp_path, monkeypatch):
    monkeypatch.setattr("beamsplat.common.mapfiles.textured_mesh.MAX_TEXTURE_PX", 256)
    mesh = wall()
    choice = choose_views(mesh, drive.views, [k.camera for k in drive.keyframes])
    images = ImageOf(drive.keyframes, drive.images.__getitem__)
    width, height = write_textured_mesh(tmp_path / "wall.glb", mesh, choice, images)
    assert max(width, height) <= 256
    points, colours = texture_colours(tmp_path / "wall.glb")
    off = np.abs(colours - colour_at(points))[choice.view >= 0]
    assert np.percentile(off, 95) < 0.06
