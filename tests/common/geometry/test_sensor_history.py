"""Beams of a moving, turning robot, brought to the time of a picture, lie where the walls are."""

import numpy as np
import pytest

from beamsplat.common.geometry.sensor_history import BEAMS_WITHIN_NS, EXTRAPOLATE_NS, SensorHistory, TimedScan
from beamsplat.common.geometry.transforms import se2_to_se3, transform_points

S = 1_000_000_000
SPEED_M_S, TURN_RAD_S, WALL_X_M = 0.5, 0.8, 4.0


def _pose(stamp_ns):
    t = stamp_ns / S
    return se2_to_se3(np.array([SPEED_M_S * t, 0.3, TURN_RAD_S * t]))


def _scan(stamp_ns, beams=360, time_increment_s=0.1 / 360):
    """What a lidar on the body sees of the plane x = WALL_X_M, each beam at its own time."""
    angle = -np.pi / 3 + np.arange(beams) * (2 * np.pi / 3 / beams)
    ranges = np.full(beams, np.inf, np.float32)
    for i, a in enumerate(angle):
        x, _, yaw = SPEED_M_S * (t := stamp_ns / S + i * time_increment_s), 0.3, TURN_RAD_S * t
        ahead = np.cos(a + yaw)
        if ahead > 0.2:
            ranges[i] = (WALL_X_M - x) / ahead
    return TimedScan(stamp_ns, angle[0], angle[1] - angle[0], time_increment_s, 0.1, 30.0, ranges)


@pytest.fixture
def history():
    history = SensorHistory(np.eye(4))
    history.add_scan(_scan(300_000_000))
    history.add_scan(_scan(400_000_000))
    for i in range(11):
        history.add_pose(i * S // 10, _pose(i * S // 10))
    return history


@pytest.mark.parametrize("stamp_ns", [330_000_000, 420_000_000, 480_000_000])
def test_moved_beams_lie_on_the_wall(history, stamp_ns):
    beams, age_ns = history.beams(stamp_ns)
    assert len(beams) > 200
    assert abs(age_ns) <= 50_100_000
    points_map = transform_points(_pose(stamp_ns), beams.points_body_m)
    assert np.abs(points_map[:, 0] - WALL_X_M).max() < 0.002  # the arc between two poses is cut straight


def test_beams_that_are_not_moved_would_miss_it_by_centimetres(history):
    scan = history.scan_near(480_000_000)
    frozen = TimedScan(**{**scan.__dict__, "time_increment_s": 0.0, "stamp_ns": 480_000_000})
    points_map = transform_points(_pose(480_000_000), history.beams_of(frozen, 480_000_000).points_body_m)
    assert np.abs(points_map[:, 0] - WALL_X_M).max() > 0.05


def test_poses_between_and_beyond(history):
    np.testing.assert_allclose(history.pose(450_000_000), _pose(450_000_000), atol=1e-3)
    np.testing.assert_allclose(history.pose(S + EXTRAPOLATE_NS), _pose(S + EXTRAPOLATE_NS), atol=1e-2)
    assert history.pose(S + EXTRAPOLATE_NS + 1) is None
    assert history.pose(-1) is None


def test_beams_of_another_moment_are_not_used(history):
    last = history.scan_near(480_000_000)
    assert len(history.beams(last.middle_ns + BEAMS_WITHIN_NS + 1)[0]) == 0


def _with_mask(history, moving):
    history.add_scan(_scan(1_000_000_000))
    history.add_mask(1_000_000_000, moving)
    return history.add_pose(1_100_000_000, _pose(1_100_000_000))


def test_returns_of_dynamic_objects_are_left_out_and_given_apart(history):
    moving = np.zeros(360, bool)
    moving[100:150] = True
    assert [scan.stamp_ns for scan in _with_mask(history, moving)] == [1_000_000_000]
    beams, _ = history.beams(1_050_000_000)
    assert not set(beams.index) & set(range(100, 150))
    assert set(beams.index) & set(range(150, 160))
    assert len(history.moving_returns(1_050_000_000)) == 50
    assert len(history.moving_returns(450_000_000)) == 0


def test_a_mask_of_another_length_or_scan_marks_nothing(history):
    _with_mask(history, np.ones(7, bool))
    assert len(history.moving_returns(1_050_000_000)) == 0
    history.add_mask(123, np.ones(360, bool))
    assert len(history.moving_returns(1_050_000_000)) == 0


def test_a_scan_is_complete_with_the_pose_of_its_last_beam_with_or_without_a_mask(history):
    history.add_scan(_scan(1_000_000_000))
    assert not history.decided_scan_near(1_050_000_000)
    assert history.add_pose(1_090_000_000, _pose(1_090_000_000)) == []
    completed = history.add_pose(1_100_000_000, _pose(1_100_000_000))
    assert [scan.stamp_ns for scan in completed] == [1_000_000_000]
    assert history.decided_scan_near(1_050_000_000)
    assert history.scan_near(1_050_000_000).stamp_ns == 1_000_000_000


def test_without_waiting_the_newest_scan_serves_at_once():
    history = SensorHistory(np.eye(4), complete_only=False)
    for i in range(4):
        history.add_pose(i * S // 10, _pose(i * S // 10))
    history.add_scan(_scan(300_000_000))
    beams, _ = history.beams(310_000_000)
    points_map = transform_points(_pose(310_000_000), beams.points_body_m)
    assert np.abs(points_map[:, 0] - WALL_X_M).max() < 0.005


def test_scans_without_poses_are_dropped_and_counted():
    history = SensorHistory(np.eye(4), keep_s=1.0)
    for i in range(1000):
        history.add_scan(_scan(i * S // 10, beams=8))
    assert len(history._incomplete) <= 12
    assert history.expired > 980


def test_a_clock_set_back_starts_the_history_afresh(history):
    history.add_pose(50, np.eye(4))
    assert history.newest_pose_ns == 50
    assert history.scan_near(480_000_000) is None
    assert history.pose(60) is not None


def test_memory_is_bounded():
    history = SensorHistory(np.eye(4), keep_s=1.0)
    for i in range(1000):
        history.add_pose(i * S // 10, np.eye(4))
        history.add_scan(_scan(i * S // 10, beams=8))
    assert len(history._poses) <= 12
    assert len(history._scans) <= 12


@pytest.mark.parametrize("complete_only", [True, False])
@pytest.mark.parametrize(
    "stamp_of",
    [lambda i: i * S // 10, lambda i: 5 * S, lambda i: 4000 * S - i * S // 10, lambda i: i % 2 * 10**18],
    ids=["without poses", "the clock stands still", "the clock runs backwards", "the clock jumps"],
)
def test_an_hour_of_scans_without_poses_takes_bounded_memory(stamp_of, complete_only):
    history = SensorHistory(np.eye(4), complete_only=complete_only)
    ranges = np.ones(4, np.float32)
    for i in range(36_000):
        history.add_scan(TimedScan(stamp_of(i), 0.0, 0.1, 0.001, 0.1, 30.0, ranges))
    assert len(history._incomplete) + len(history._scans) <= 256
    if complete_only:
        assert history.expired == 36_000 - len(history._incomplete)
