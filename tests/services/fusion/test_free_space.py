"""Returns in observed free space are dynamic; narrow objects do not become walls."""

import numpy as np

from beamsplat.common.geometry.transforms import se2_to_se3, transform_points
from beamsplat.services.fusion.free_space import FreeSpaceGrid
from beamsplat.services.fusion.surfaces import remove_narrow_objects
from tests.services.fusion.room import in_map, scan

POSE = se2_to_se3(np.array([0.3, 0.2, 0.1]))


def test_returns_on_a_person_who_walks_in_are_dynamic_and_those_on_walls_are_static():
    space = FreeSpaceGrid()
    for k in range(10):
        T = se2_to_se3(np.array([0.05 * k, 0.0, 0.02 * k]))
        space.add(T[:2, 3], in_map(T, scan(T)))
    beams = scan(POSE)
    points = beams.points_body_m.copy()
    angle = np.arctan2(points[:, 1], points[:, 0])
    person = np.abs(angle) < 0.08
    points[person, :2] *= (2.0 / np.hypot(points[person, 0], points[person, 1]))[:, None]
    moving = space.dynamic_returns(transform_points(POSE, points))
    assert np.array_equal(moving, person)


def test_a_table_leg_is_not_a_wall_but_a_cupboard_is():
    azimuth = np.linspace(-0.5, 0.5, 101)
    reach = np.full(101, 4.0)
    reach[40:43] = 1.5
    reach[70:95] = 2.0
    flat = remove_narrow_objects(azimuth, reach)
    assert np.allclose(flat[40:43], 4.0)
    assert np.allclose(flat[70:95], 2.0)
