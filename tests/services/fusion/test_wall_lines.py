"""Walls continued occluded_walls furniture: found from pieces in any direction, met where they stand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.services.fusion.lidar_map import LidarMap
from beamsplat.services.fusion.surfaces import CeilingDetector
from beamsplat.services.fusion.wall_lines import find_lines, ranges_to_lines

CELL_M = 0.04


def wall(a, b, noise_m=0.005, seed=0):
    n = int(np.linalg.norm(np.subtract(b, a)) / CELL_M)
    points = np.linspace(a, b, n)
    return points + np.random.default_rng(seed).normal(0, noise_m, points.shape)


@settings(max_examples=30, deadline=None)
@given(st.floats(0, 2 * np.pi), st.floats(-5, 5), st.floats(-5, 5))
def test_a_wall_is_found_in_any_direction(turn, x, y):
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    points = wall((-2.0, 1.5), (2.0, 1.5)) @ R.T + [x, y]
    (line,) = find_lines(points, CELL_M)
    assert np.abs(points @ line.normal - line.offset_m).max() < 0.03
    assert line.high_m - line.low_m == pytest.approx(4.0, abs=0.1)


def test_a_wall_behind_a_sofa_is_met_where_it_stands():
    """y = 3, seen beside a sofa at y = 2.2 from x = -1 to 1."""
    points = np.concatenate(
        [wall((-3, 3), (-1, 3)), wall((1, 3), (3, 3)), wall((-1, 2.2), (1, 2.2)), wall((-3, -1), (-3, 3))]
    )
    lines = find_lines(points, CELL_M)
    azimuth = np.radians([80.0, 90.0, 100.0])
    front = 2.2 / np.sin(azimuth)
    ranges = ranges_to_lines(lines, np.zeros(2), azimuth, front + 0.15, 2)
    np.testing.assert_allclose(ranges[0], 3.0 / np.sin(azimuth), atol=0.02)
    assert not np.any(ranges < front + 0.15)


def test_clutter_in_line_is_no_wall():
    random = np.random.default_rng(1)
    scattered = random.uniform(-3, 3, (400, 2))
    assert find_lines(scattered, CELL_M) == []


def test_the_map_gives_the_points_that_scans_agree_on():
    lidar_map = LidarMap()
    for seed in range(4):
        lidar_map.add(wall((-1.0, 2.0), (1.0, 2.0), 0.003, seed))
    lidar_map.add(np.array([[5.0, 5.0]]))  # seen once: nobody stands there
    points = lidar_map.points()
    assert len(points) > 30
    assert np.abs(points[:, 1] - 2.0).max() < 0.01


def test_ceilings_are_peaks_of_the_evidence_and_not_their_shoulders():
    finder = CeilingDetector()
    gain = np.maximum(4000.0 - 20000.0 * (finder.heights_m - 2.68) ** 2, 0.0)
    finder.add(gain)
    (height,) = finder.heights(500.0)
    assert height == pytest.approx(2.68, abs=0.005)
    finder.add(4000.0 * np.exp(-(((finder.heights_m - 3.4) / 0.1) ** 2)))
    assert finder.heights(500.0) == pytest.approx((3.4, 2.68), abs=0.03)  # the older one has faded
