"""Points of the cloud lie on the room's surfaces; a person who walks in is masked, a wall is not."""

import numpy as np

from beamsplat.common.geometry.beams import Beams
from beamsplat.common.geometry.transforms import se2_to_se3, transform_points
from beamsplat.services.fusion.cloud import coloured_cloud
from beamsplat.services.fusion.movers import FreeSpace, mover_mask
from beamsplat.services.fusion.result import Fused
from beamsplat.services.fusion.surfaces import without_posts
from tests.services.fusion.room import CAMERA, T_BODY_CAMERA, in_map, render, scan

POSE = se2_to_se3(np.array([0.3, 0.2, 0.1]))


def test_the_cloud_lies_on_the_room_and_wears_its_colours():
    picture, truth = render(POSE)
    sigma = 0.01 * truth
    sigma[:100] = truth[:100]
    points, colours = coloured_cloud(Fused(truth, sigma), picture, CAMERA, POSE @ T_BODY_CAMERA, stride=2)
    surfaces = np.stack([
        points[:, 2], points[:, 2] - 2.4, points[:, 0] - 5.0, points[:, 1] - 1.8, points[:, 1] + 1.8,
        points[:, 0] - 4.2, points[:, 2] - 0.75,
    ])  # fmt: skip
    assert np.abs(surfaces).min(axis=0).max() < 1e-3
    assert len(points) == 70 * 160
    assert np.array_equal(colours[0], picture[101, 1])


def test_a_person_who_walks_in_is_masked_and_the_walls_are_not():
    space = FreeSpace()
    for k in range(10):
        T = se2_to_se3(np.array([0.05 * k, 0.0, 0.02 * k]))
        space.add(T[:2, 3], in_map(T, scan(T)))
    beams = scan(POSE)
    points = beams.points_body_m.copy()
    angle = np.arctan2(points[:, 1], points[:, 0])
    person = np.abs(angle) < 0.08
    points[person, :2] *= (2.0 / np.hypot(points[person, 0], points[person, 1]))[:, None]
    seen = Beams(points, beams.index, beams.sigma_m)
    moving = space.contradicted(transform_points(POSE, points))
    assert np.array_equal(moving, person)
    _, truth = render(POSE)
    depth = truth.copy()
    depth[60:200, 140:180] = 1.9
    mask = mover_mask(seen, moving, depth, CAMERA, T_BODY_CAMERA)
    assert mask[80:180, 145:175].mean() > 0.9
    assert not mask[:, :120].any()
    assert not mask[:, 210:].any()


def test_a_table_leg_is_not_a_wall_but_a_cupboard_is():
    azimuth = np.linspace(-0.5, 0.5, 101)
    reach = np.full(101, 4.0)
    reach[40:43] = 1.5
    reach[70:95] = 2.0
    flat = without_posts(azimuth, reach)
    assert np.allclose(flat[40:43], 4.0)
    assert np.allclose(flat[70:95], 2.0)
