"""Deskewing and projection of beams, occlusion, and the depth of walls and floor."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from beamsplat.common.geometry.beams import (
    Beams,
    azimuth_and_range,
    deskew_beams,
    occluded_beams,
    plane_depth,
    project_beams,
    scan_points,
    wall_depth,
    wall_ranges,
)
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import camera_mount, lidar_mount
from beamsplat.common.geometry.transforms import interpolate, inverse, se2_to_se3, transform_points

CAMERA = Pinhole(530.0, 530.0, 319.5, 239.5, 640, 480)


def test_scan_points_omits_invalid_and_missing_returns():
    ranges = np.array([np.inf, np.nan, -1.0, 0.05, 2.0, 20.0], np.float32)
    points, index = scan_points(ranges, 0.0, 0.1, 0.1, 12.0)
    assert index.tolist() == [4]
    assert np.allclose(points, [[2 * np.cos(0.4), 2 * np.sin(0.4), 0.0]])


@given(
    st.floats(-0.5, 0.5),
    st.floats(-0.5, 0.5),
    st.floats(-0.6, 0.6),
    st.floats(-3, 3),
)
def test_deskewed_beams_hit_the_same_world_points(dx, dy, turn, heading):
    T0 = se2_to_se3(np.array([1.0, 2.0, heading]))
    T1 = T0 @ se2_to_se3(np.array([dx, dy, turn]))
    T_image = interpolate(T0, T1, 0.37)
    T_body_lidar = lidar_mount(0.05, 0.02, 0.18, yaw_left_rad=0.3)
    rng = np.random.default_rng(0)
    world = np.column_stack([rng.uniform(-5, 5, (20, 2)), np.full(20, 0.18)])
    fraction = np.linspace(0, 1, 20)
    seen = np.array(
        [
            transform_points(inverse(interpolate(T0, T1, f) @ T_body_lidar), p[None])[0]
            for f, p in zip(fraction, world)
        ]
    )
    moved = deskew_beams(seen, fraction, T0, T1, T_image, T_body_lidar)
    assert np.allclose(transform_points(T_image, moved), world, atol=1e-9)


def test_only_beams_behind_a_nearer_edge_are_occluded():
    T = camera_mount(0.0, 0.3, 0.45)  # left of the lidar
    near = np.column_stack([np.full(60, 1.0), np.linspace(-0.05, 0.2, 60), np.full(60, 0.18)])
    far = np.column_stack([np.full(60, 3.0), np.linspace(-0.9, -0.1, 60), np.full(60, 0.18)])
    hidden = occluded_beams(np.concatenate([near, far]), T)
    assert not hidden[:60].any()
    azimuth, _ = azimuth_and_range(np.concatenate([near, far]), T)
    covered = (azimuth[60:] > azimuth[:60].min()) & (azimuth[60:] < azimuth[:60].max())
    assert covered.any()
    assert (~covered).any()
    assert np.mean(hidden[60:] == covered) > 0.95


def test_projected_depth_is_optical_z_not_range():
    T = camera_mount(0.1, 0.0, 0.45, pitch_down_rad=0.03)
    point = np.array([[3.1, 1.0, 0.18]])
    _, z, _ = project_beams(Beams(point, np.zeros(1, int), np.full(1, 0.01)), CAMERA, T)
    assert np.allclose(z, 3.0 * np.cos(0.03) + 0.27 * np.sin(0.03), atol=1e-6)


def test_wall_ranges_interpolates_a_straight_wall():
    angle = np.linspace(-0.5, 0.5, 101)
    r = 3.0 / np.cos(angle)
    between = angle[:-1] + 0.0031
    assert np.allclose(wall_ranges(between, angle, r), 3.0 / np.cos(between), atol=1e-3)
    assert np.isnan(wall_ranges(np.array([0.8]), angle, r)).all()


def test_wall_and_floor_depth_match_geometry():
    T = camera_mount(0.1, 0.0, 0.45, pitch_down_rad=0.035)
    rays = CAMERA.resized(64, 48).ray_grid() @ T[:3, :3].T
    angle = np.linspace(-0.7, 0.7, 301)
    wall = wall_depth(rays, angle, 2.0 / np.cos(angle))
    on_wall = T[:3, 3] + wall[..., None] * rays
    assert np.allclose(on_wall[..., 0], 2.1, atol=2e-3)
    floor = plane_depth(rays, 0.45)
    on_floor = T[:3, 3] + floor[..., None] * rays
    assert np.allclose(on_floor[np.isfinite(floor)][:, 2], 0.0, atol=1e-9)
    assert np.isnan(floor[0]).all()
