"""Rate limits, poses between poses, bounded paths, sweeps of a moving lidar."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamsplat.common.geometry.tracks import BoundedPath, PoseBuffer, RateLimit, scan_points, sweep_to_world
from beamsplat.common.geometry.transforms import inverse, se2_to_se3, transform_points

NS = 1_000_000_000


def test_a_rate_limit_counts_measurement_time():
    limit = RateLimit({"image": 10.0, "grid": 0.0})
    drawn = [i for i in range(90) if limit.due("image", NS + i * NS // 30)]
    assert len(drawn) == 30
    assert not limit.due("grid", NS)
    assert limit.due("image", 5, "other"), "each entity has its own"
    assert limit.due("image", 7), "a recording that loops starts afresh"


def test_a_stream_at_the_limit_passes_in_spite_of_jitter():
    rng = np.random.default_rng(1)
    stamps = NS + np.arange(100) * NS // 10 + rng.integers(-3_000_000, 3_000_000, 100)
    limit = RateLimit({"scan": 10.0})
    assert sum(limit.due("scan", int(s)) for s in stamps) == 100


def test_poses_between_and_beyond_those_known():
    poses = PoseBuffer()
    assert not poses
    assert poses.at(0) is None
    for i in range(300):
        poses.add(i * NS // 10, se2_to_se3(np.array([0.1 * i, 0.0, 0.01 * i])))
    T = poses.at(25 * NS + NS // 20)
    np.testing.assert_allclose(T, se2_to_se3(np.array([25.05, 0.0, 2.505])), atol=1e-9)
    np.testing.assert_allclose(poses.at(30 * NS)[:3, 3], [29.9, 0.0, 0.0])  # 0.1 s after the last
    assert poses.at(31 * NS) is None
    assert poses.at(0) is None, "only the last ones are kept"
    poses.add(NS, np.eye(4))
    assert poses.newest[0] == NS
    assert poses.at(25 * NS) is None


@given(st.integers(16, 200), st.integers(1, 3000))
def test_a_path_is_bounded_and_ends_where_the_robot_is(max_points, steps):
    path = BoundedPath(max_points, 0.05)
    for i in range(steps):
        path.add(np.array([0.04 * i, 0.0, 0.0]))
    points = path.points_m
    assert len(points) <= max_points + 1
    assert points.dtype == np.float32
    np.testing.assert_allclose(points[0], 0.0)
    np.testing.assert_allclose(points[-1], [0.04 * (steps - 1), 0.0, 0.0], rtol=1e-6)
    assert np.all(np.diff(points[:, 0]) >= 0.0)


def test_only_returns_become_points():
    ranges = np.array([1.0, np.inf, np.nan, -1.0, 0.0, 0.05, 13.0, 2.0], np.float32)
    points, beams = scan_points(ranges, 0.0, np.pi / 14, (0.1, 12.0))
    assert beams.tolist() == [0, 7]
    np.testing.assert_allclose(points, [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize(("turn_rad", "limit_m"), [(0.0, 1e-9), (0.1, 0.007)])
def test_a_sweep_taken_in_motion_lies_on_what_it_saw(turn_rad, limit_m):
    """Points at 5 m, the robot driving 5 cm and turning while the mirror goes round."""
    share = np.linspace(0.0, 1.0, 360)
    angles = 2.0 * np.pi * share
    world = 5.0 * np.stack([np.cos(angles), np.sin(angles), np.zeros(360)], -1)
    T_at = [se2_to_se3(np.array([0.05 * s, 0.0, turn_rad * s])) for s in share]
    body = np.array([transform_points(inverse(T), p[None])[0] for T, p in zip(T_at, world)])
    drawn = sweep_to_world(body, share, T_at[0], T_at[-1])
    assert np.max(np.linalg.norm(drawn - world, axis=1)) < limit_m
