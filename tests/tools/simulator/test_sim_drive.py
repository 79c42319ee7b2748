"""The robot's path and its speed, wheel odometry with drift, free space, paths of dynamic objects."""

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import inverse, se2_to_se3, wrap_angle
from beamsplat.tools.simulator.actors import (
    MIN_ROBOT_DISTANCE_M,
    TURN_RADIUS_M,
    ActorPath,
    choose_actor_paths,
)
from beamsplat.tools.simulator.clearance_grid import ClearanceGrid
from beamsplat.tools.simulator.mesh import Material, MeshBuilder
from beamsplat.tools.simulator.path import DrivePath, MotionLimits, resample_closed
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.settings import WheelSettings
from beamsplat.tools.simulator.shapes import box
from beamsplat.tools.simulator.wheels import WheelOdometrySimulator
from tests.tools.simulator.room import draw_room

SQUARE = resample_closed(
    np.array([[0.0, 0.0], [5.0, 0.0], [5.5, 1.5], [5.0, 3.5], [0.0, 3.5], [-0.5, 2.0]]), 0.5
)
LIMITS = MotionLimits()


@pytest.fixture(scope="module")
def drive():
    return DrivePath(SQUARE, LIMITS)


def test_speed_turn_rate_and_acceleration_stay_within_the_limits(drive):
    times = np.arange(0.0, drive.lap_s, 0.02)
    step = np.diff(drive.pose_at(times), axis=0)
    speed, turn = np.linalg.norm(step[:, :2], axis=1) / 0.02, wrap_angle(step[:, 2]) / 0.02
    assert speed.max() <= LIMITS.speed_m_s * 1.01
    assert np.abs(turn).max() <= LIMITS.turn_rad_s * 1.02
    assert np.abs(np.diff(speed)).max() / 0.02 < LIMITS.acceleration_m_s2 * 1.3
    assert speed.max() > 0.9 * LIMITS.speed_m_s


def test_a_lap_is_whole_seconds_and_ends_at_rest_where_it_began(drive):
    assert drive.lap_s == round(drive.lap_s)
    np.testing.assert_allclose(drive.pose_at(0.0), drive.pose_at(drive.lap_s - 1e-3), atol=1e-3)
    np.testing.assert_allclose(drive.pose_at(7.25), drive.pose_at(3 * drive.lap_s + 7.25), atol=1e-9)
    for start in (0.0, drive.lap_s):  # at rest: moves less than 0.5 mm in 20 ms
        move = drive.pose_at(start + 0.02) - drive.pose_at(start)
        assert np.linalg.norm(move[:2]) < 5e-4


def test_the_robot_never_slides_sideways(drive):
    pose = drive.pose_at(np.arange(0.0, drive.lap_s, 0.01))
    move = np.diff(pose[:, :2], axis=0)
    sideways = -np.sin(pose[:-1, 2]) * move[:, 0] + np.cos(pose[:-1, 2]) * move[:, 1]
    assert np.abs(sideways).max() < 2e-4


def test_odometry_drifts_two_to_three_percent_of_the_way(drive):
    times = np.arange(0.0, 3 * drive.lap_s, 0.02)
    truth = drive.pose_at(times)
    for seed in range(6):
        odometry = WheelOdometrySimulator(WheelSettings(), np.random.default_rng(seed)).measure(truth, 0.02)
        T_true, T_odom = se2_to_se3(truth), se2_to_se3(odometry.pose_odom_body)
        shares = []
        for start in range(0, len(times) - 250, 250):
            stop = start + 250
            moved, counted = inverse(T_true[start]) @ T_true[stop], inverse(T_odom[start]) @ T_odom[stop]
            way = np.linalg.norm(np.diff(truth[start : stop + 1, :2], axis=0), axis=1).sum()
            shares.append(np.linalg.norm((moved - counted)[:2, 3]) / way)
        assert 0.015 < np.median(shares) < 0.032


def test_odometry_without_errors_is_the_truth_however_the_calls_are_split(drive):
    perfect = WheelSettings(scale_error=(0.0, 0.0), turn_error=(0.0, 0.0), noise=0.0)
    truth = drive.pose_at(np.arange(0.0, 20.0, 0.02))
    whole = WheelOdometrySimulator(perfect, np.random.default_rng(0)).measure(truth, 0.02)
    expected = inverse(se2_to_se3(truth[0])) @ se2_to_se3(truth)
    np.testing.assert_allclose(se2_to_se3(whole.pose_odom_body)[:, :2, 3], expected[:, :2, 3], atol=2e-3)
    wheels = WheelOdometrySimulator(perfect, np.random.default_rng(0))
    parts = [wheels.measure(part, 0.02).pose_odom_body for part in np.array_split(truth, 7)]
    np.testing.assert_allclose(np.concatenate(parts), whole.pose_odom_body, atol=1e-9)


def test_odometry_reports_the_speed_of_its_own_poses(drive):
    truth = drive.pose_at(np.arange(0.0, 20.0, 0.02))
    odometry = WheelOdometrySimulator(WheelSettings(noise=0.0), np.random.default_rng(3)).measure(truth, 0.02)
    moved = np.linalg.norm(np.diff(odometry.pose_odom_body[:, :2], axis=0), axis=1) / 0.02
    np.testing.assert_allclose(odometry.speed_m_s[1:], moved, atol=2e-3)
    assert odometry.speed_m_s[0] == 0.0


def test_a_path_is_closed_smooth_and_of_constant_speed():
    path = ActorPath((0.0, 0.0), (2.0, 1.0), 3, 0.2, 30.0)
    times = np.linspace(0.0, 30.0, 3001)
    position, yaw, travelled_m = path.at(times)
    np.testing.assert_allclose(position[0], position[-1], atol=1e-9)
    step = np.diff(position, axis=0)
    np.testing.assert_allclose(np.linalg.norm(step, axis=1), 3 * path.round_length_m / 3000, rtol=1e-2)
    heading = np.arctan2(step[:, 1], step[:, 0])
    assert np.abs(wrap_angle(heading - yaw[:-1])).max() < 0.1
    assert np.abs(wrap_angle(np.diff(yaw))).max() < 1.1 * (path.round_length_m * 3 / 3000) / TURN_RADIUS_M
    assert travelled_m[-1] - travelled_m[0] == pytest.approx(3 * path.round_length_m)


@pytest.fixture(scope="module")
def obstacle_course(sizes):
    b = MeshBuilder(sizes, edge_m=0.5)
    draw_room(b)
    box(b, (0.0, 0.0, 0.0), (1.6, 0.8, 0.9), Material("plain"))
    mesh = b.build()
    return mesh, RayCaster.of(mesh)


def test_clearance_is_the_distance_to_walls_and_blocks(obstacle_course):
    space = ClearanceGrid(*obstacle_course)
    points = np.array([[2.0, 0.0], [-2.0, 0.0], [0.0, 1.2], [2.5, 0.0], [0.0, 0.0], [3.4, 0.0]])
    np.testing.assert_allclose(space.clearance(points), [1.0, 1.0, 0.8, 0.5, 0.0, 0.0], atol=0.07)


def test_a_tour_and_its_relaxation_keep_clear_of_obstacles(obstacle_course):
    space = ClearanceGrid(*obstacle_course)
    tour = space.tour(np.random.default_rng(0), stops=5)
    route = resample_closed(space.relax(resample_closed(tour, 0.05)), 0.05)
    assert space.clearance(route).min() > 0.3
    winding = np.sum(wrap_angle(np.diff(np.arctan2(route[:, 1], route[:, 0]))))
    assert np.ptp(route[:, 0]) > 3.0
    assert np.isfinite(winding)


def test_dynamic_objects_keep_clear_of_the_robot(obstacle_course):
    mesh, caster = obstacle_course
    space = ClearanceGrid(mesh, caster)
    loop = resample_closed(np.array([[2.4, -1.4], [2.4, 1.4], [1.4, 1.4], [1.4, -1.4]]), 0.2)
    drive = DrivePath(loop, LIMITS)
    paths = choose_actor_paths(space, drive, caster, 1, drive.lap_s, np.random.default_rng(0), tries=150)
    times = np.arange(0.0, drive.lap_s, 0.25)
    gap = np.linalg.norm(paths[0].at(times)[0] - drive.pose_at(times)[:, :2], axis=1)
    assert gap.min() >= MIN_ROBOT_DISTANCE_M
