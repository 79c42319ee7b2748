"""The generated home: floor plans of many seeds, and one complete home."""

import hashlib

import numpy as np
import pytest

from beamsplat.tools.simulator.clearance_grid import ClearanceGrid
from beamsplat.tools.simulator.home import build_home, floor_plan
from beamsplat.tools.simulator.path import DrivePath, MotionLimits, resample_closed
from beamsplat.tools.simulator.ray_caster import RayCaster


@pytest.mark.parametrize("seed", range(40))
def test_every_plan_has_four_rooms_in_a_ring_and_a_route_through_their_doors(seed):
    rooms, route = floor_plan(np.random.default_rng(seed))
    assert sorted(room.name for room in rooms) == ["bedroom", "kitchen", "living", "study"]
    length = np.linalg.norm(np.diff(np.vstack([route, route[:1]]), axis=0), axis=1).sum()
    assert 24.0 < length < 40.0
    for room in rooms:
        assert room.x1 - room.x0 > 3.5
        assert room.y1 - room.y0 > 3.5
        inside = np.all((route > [room.x0, room.y0]) & (route < [room.x1, room.y1]), axis=1)
        assert inside.sum() * 0.05 > 3.0
        doors = [o for side in room.openings.values() for o in side if o.kind == "door"]
        assert len(doors) == 2
        for side, holes in room.openings.items():
            for hole in holes:
                assert 0.0 < hole.s0 < hole.s1 < room.length(side)


@pytest.mark.slow
def test_a_home_can_be_driven_through_and_is_the_same_every_time():
    seed = 5
    home = build_home(seed)
    mesh = home.mesh
    again = build_home(seed).mesh
    assert hashlib.sha256(mesh.vertices_m).digest() == hashlib.sha256(again.vertices_m).digest()
    assert hashlib.sha256(mesh.uvs).digest() == hashlib.sha256(again.uvs).digest()
    assert np.all(np.isfinite(mesh.vertices_m))
    assert np.all(np.isfinite(mesh.normals))
    assert {m.texture for m in mesh.materials} <= set(home.textures)
    space = ClearanceGrid(mesh, RayCaster.of(mesh))
    route = resample_closed(space.relax(home.route_m), 0.3)
    drive = DrivePath(route, MotionLimits())
    assert 24.0 < drive.length_m < 36.0
    path = drive.pose_at(np.linspace(0.0, drive.lap_s, 2000))[:, :2]
    assert space.clearance(path).min() > 0.24
