"""The lidar map: returns where they were measured, and bounded memory wherever the robot is."""

import numpy as np
import pytest

from beamsplat.services.fusion.lidar_map import LidarMap


def wall(x_m: float, y_m: float) -> np.ndarray:
    """Return the returns [50, 3] on a wall of 2 m at (x, y), m."""
    return np.column_stack([np.full(50, x_m), y_m + np.linspace(0.0, 2.0, 50), np.zeros(50)])


def test_walls_stay_where_they_are_while_the_grid_grows():
    lidar_map = LidarMap()
    for x in (0.0, 12.0, -30.0, 60.0):
        for _ in range(2):
            lidar_map.add(wall(x, 0.3 * x))
    points = lidar_map.points(min_hits=2)
    for x in (0.0, 12.0, -30.0, 60.0):
        near = points[np.abs(points[:, 0] - x) < 0.03]
        assert len(near) > 40
        assert near[:, 1].min() == pytest.approx(0.3 * x, abs=0.06)


@pytest.mark.parametrize("far_m", [500.0, 1e5, 1e8])
def test_a_pose_far_away_does_not_take_the_memory(far_m):
    lidar_map = LidarMap()
    lidar_map.add(wall(0.0, 0.0))
    for _ in range(3):
        lidar_map.add(wall(far_m, -far_m))
    assert lidar_map._cells.nbytes < 250e6
    if far_m < 1e6:
        assert np.abs(lidar_map.points()[:, 0] - far_m).max() < 0.03


def test_one_return_far_away_does_not_take_the_memory():
    lidar_map = LidarMap()
    lidar_map.add(np.vstack([wall(0.0, 0.0), [[9e7, 0.0, 0.0]]]))
    assert lidar_map._cells.nbytes < 10e6
    assert len(lidar_map.points(min_hits=1)) >= 40
