"""Rendered views: depth against geometry, light, texture filtering, dynamic objects, determinism."""

import numpy as np
import pytest

from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.tools.simulator.actors import ActorLighting, ActorPath, ActorSet
from beamsplat.tools.simulator.camera import pixel_rays
from beamsplat.tools.simulator.humanoid import person
from beamsplat.tools.simulator.light import bake
from beamsplat.tools.simulator.mesh import Material, MeshBuilder
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.render import SceneRenderer, ray_table
from beamsplat.tools.simulator.shade import sample, shading_tables
from tests.tools.simulator.room import HALF_X, draw_room, room_distance

K = np.array([[130.0, 0.0, 79.5], [0.0, 130.0, 59.5], [0.0, 0.0, 1.0]])
RAYS = pixel_rays(160, 120, K)
TABLE = ray_table(RAYS)


def pose(x, y, yaw):
    return se2_to_se3(np.array([x, y, yaw])) @ camera_mount(0.1, 0.0, 0.45, pitch_down_rad=0.05)


@pytest.fixture(scope="module")
def renderer(room, room_atlas, lamp):
    caster = RayCaster.of(room)
    return SceneRenderer(
        caster, shading_tables(room, room_atlas, bake(room, room_atlas, (lamp,), caster, rays=16))
    )


@pytest.mark.parametrize("yaw", [0.0, 0.9, 2.5, -1.8])
def test_depth_is_the_analytic_distance_along_the_optical_axis(renderer, yaw):
    T = pose(-0.7, 0.4, yaw)
    depth = renderer.render(T, TABLE).depth_z_m
    rays = RAYS @ T[:3, :3].T  # z = 1 in the camera frame: length along the ray is optical z
    np.testing.assert_allclose(depth, room_distance(T[:3, 3], rays), rtol=1e-5, atol=1e-4)


def test_a_lamp_gives_the_irradiance_of_the_inverse_square_law(sizes, room_atlas, lamp):
    b = MeshBuilder(sizes, edge_m=0.25)
    b.quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), Material("plain"))
    floor = b.build()
    light = bake(floor, room_atlas, (lamp,), RayCaster.of(floor), rays=8)
    x, y = floor.vertices_m[:, 0], floor.vertices_m[:, 1]
    squared = x**2 + y**2 + 4.0
    expected = 3.0 * (2.0 / np.sqrt(squared)) / squared / np.pi
    inner = (np.abs(x) < 0.8) & (np.abs(y) < 0.8)  # the rim is smoothed from one side only
    ambient = (light[:, 0] - expected)[inner]
    assert np.ptp(ambient) < 0.03 * expected.max()  # the rest is the constant ambient term


def test_a_texture_is_sampled_as_its_average_from_far_and_as_its_texels_from_near(room, room_atlas):
    scene = shading_tables(room, room_atlas, np.ones((len(room.vertices_m), 3), np.float32))
    noise = room_atlas.index("noise")
    out = np.zeros(3)
    sample(scene, noise, 0.3, 0.6, 1.0, 0.0, 0.0, 1.0, out)
    np.testing.assert_allclose(out, room_atlas.mean[noise], rtol=0.02)
    texels = (room_atlas.texels[: 64 * 64].reshape(64, 64, 3) / 255.0) ** 2
    sample(scene, noise, (10 + 0.5) / 64, 1.0 - (20 + 0.5) / 64, 1e-6, 0.0, 0.0, 1e-6, out)
    np.testing.assert_allclose(out, texels[20, 10], rtol=1e-4)


def test_an_oblique_footprint_is_averaged_like_a_slow_box_filter(room, room_atlas):
    """The reference is the mean of many point samples over the parallelogram."""
    scene = shading_tables(room, room_atlas, np.ones((len(room.vertices_m), 3), np.float32))
    noise, rng = room_atlas.index("noise"), np.random.default_rng(0)
    errors, out = [], np.zeros(3)
    for _ in range(60):
        u, v = rng.random(2)
        ux, vy = 12 / 64, 2 / 64
        sample(scene, noise, u, v, ux, 0.0, 0.0, vy, out)
        fast, total = out.copy(), np.zeros(3)
        for a, b in rng.uniform(-0.5, 0.5, (400, 2)):
            sample(scene, noise, u + a * ux, v + b * vy, 1e-6, 0.0, 0.0, 1e-6, out)
            total += out
        errors.append(fast - total / 400)
    spread = np.std((room_atlas.texels[: 64 * 64] / 255.0) ** 2)
    # A filter of the right size leaves a small part of the texture's own contrast, and no bias.
    assert np.std(errors) < 0.25 * spread
    assert np.abs(np.mean(errors)) < 0.05 * spread


def test_dynamic_objects_are_masked_exactly_where_they_change_the_depth(
    renderer, room, room_atlas, sizes, lamp
):
    sizes = {name: tuple(size) for name, size in zip(room_atlas.names, room_atlas.size_m)}
    path = ActorPath((0.5, -0.4), (2.0, -0.4), 4, 0.1, 20.0)
    actors = ActorSet([person(np.random.default_rng(1), sizes)], [path])
    lighting = ActorLighting(actors, renderer.caster, renderer.scene, room_atlas, (lamp,))
    T = pose(-2.0, 0.0, 0.0)
    empty = renderer.render(T, TABLE)
    full = renderer.render(T, TABLE, lighting.snapshot(1.7))
    changed = full.depth_z_m != empty.depth_z_m
    assert 100 < full.moving.sum() < 8000
    np.testing.assert_array_equal(full.moving, changed)
    assert np.all(full.depth_z_m[full.moving] < empty.depth_z_m[full.moving])
    rays = RAYS[full.moving] @ T[:3, :3].T
    points = T[:3, 3] + full.depth_z_m[full.moving][:, None] * rays
    place = path.at(np.array(1.7))[0]
    assert np.all(np.linalg.norm(points[:, :2] - place, axis=1) < 0.75)
    assert points[:, 2].max() < 2.0
    assert points[:, 2].min() > -0.05


def test_the_same_view_gives_the_same_bytes(renderer):
    first, second = (renderer.render(pose(0.2, 0.1, 0.4), TABLE) for _ in range(2))
    assert first.radiance.tobytes() == second.radiance.tobytes()
    assert first.depth_z_m.tobytes() == second.depth_z_m.tobytes()


def test_pixels_on_an_edge_are_a_mixture(sizes, room_atlas):
    b = MeshBuilder(sizes, edge_m=0.5)
    draw_room(b, wall=Material("plain", tint=(0.1, 0.1, 0.1)))
    b.quad((HALF_X - 0.01, 0.013, 0), (0, -1.5, 0), (0, 0, 2.5), Material("plain"))
    mesh = b.build()
    scene = shading_tables(mesh, room_atlas, np.ones((len(mesh.vertices_m), 3), np.float32))
    view = SceneRenderer(RayCaster.of(mesh), scene).render(pose(0.0, 0.0, 0.0), TABLE)
    row = view.radiance[40, :, 0]
    levels = np.unique(np.round(row / row.max(), 3))
    assert np.any((levels > 0.2) & (levels < 0.9))
