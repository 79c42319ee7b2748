"""Returns on the robot's own body are found and removed; walls at a constant distance are not."""

import numpy as np
import pytest

from beamsplat.services.localization.lidar2d.scan import RawScan
from beamsplat.services.localization.lidar2d.self_returns import BINS, SelfReturns
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from tests.services.localization.world import RayCastLidar, SimulatedDrive

BEAMS = 360
ANGLES = -np.pi + np.arange(BEAMS) * 2.0 * np.pi / BEAMS
POSTS = (np.abs(ANGLES - 2.0) < 0.04) | (np.abs(ANGLES + 2.2) < 0.03)
POST_M = 0.25


def raw_scan(ranges):
    return RawScan(0, ranges.astype(np.float32), -np.pi, 2.0 * np.pi / BEAMS, 0.0, 0.1, 12.0)


def removed_beams(own: SelfReturns) -> np.ndarray:
    """Return which beams would lose a return, at any range below 1 m."""
    lost = np.zeros(BEAMS, dtype=bool)
    for range_m in np.arange(0.12, 1.0, 0.02):
        lost |= ~np.isfinite(own.without(raw_scan(np.full(BEAMS, range_m))).ranges_m)
    return lost


def test_posts_are_found_in_the_first_metres_removed_and_saved(tmp_path, rng):
    drive, lidar = SimulatedDrive(speed_m_s=0.5), RayCastLidar(beams=BEAMS, seed=3)
    slam = LidarSlam(LidarSlamSettings(), np.eye(4))
    found_m = None
    for k in range(220):
        t = 0.1 * k
        ranges = lidar.scan(drive, t)
        ranges[POSTS] = POST_M + 0.01 * rng.standard_normal(POSTS.sum())
        result = slam.add_scan(10**9 + k * 10**8, ranges, *lidar.arguments())
        assert result.status == "ok"
        if found_m is None and np.isfinite(slam.self_returns.range_m).any():
            found_m = 0.5 * t
        if result.job is not None:
            slam.apply(result.job.run())
    assert found_m is not None
    assert found_m < 7.0  # the path is straight for its first metres: turns are needed
    lost = removed_beams(slam.self_returns)
    assert lost[POSTS].all()
    assert not lost[~np.convolve(POSTS, np.ones(5), "same").astype(bool)].any()
    assert [round(s.range_m, 1) for s in slam.self_returns.sectors()] == [0.2, 0.2]
    assert not (np.hypot(*result.points_body.T) < POST_M + 0.05).any()
    slam.save(tmp_path)
    again = LidarSlam.load(tmp_path, LidarSlamSettings(), np.eye(4))
    assert np.allclose(again.self_returns.range_m, slam.self_returns.range_m, equal_nan=True)
    assert removed_beams(again.self_returns).sum() == lost.sum()


@pytest.mark.parametrize("distance_m", [0.3, 0.6])
def test_a_wall_followed_at_a_constant_distance_is_kept(distance_m, rng):
    own = SelfReturns()
    with np.errstate(divide="ignore"):
        wall_m = np.where(np.sin(ANGLES) > 0.05, distance_m / np.sin(ANGLES), np.inf)
    for k in range(400):  # 20 m; everything but the wall on the left changes
        scan = raw_scan(np.where(np.isfinite(wall_m), wall_m, 3.0 + 0.01 * k))
        assert not own.observe(scan, np.array([0.05, 0.0, 0.0]) + rng.normal(0.0, 0.001, 3))
    assert not removed_beams(own).any()


def test_the_pillar_that_the_robot_drives_around_is_kept():
    own = SelfReturns()
    ranges = np.where(np.abs(ANGLES - np.pi / 2) < 0.3, 0.5, 4.0)
    for _ in range(400):
        assert not own.observe(raw_scan(ranges), np.array([0.04, 0.0, 0.05]))
    assert not own.sectors()


def test_standing_still_tells_nothing():
    own = SelfReturns()
    for _ in range(500):
        assert not own.observe(raw_scan(np.full(BEAMS, 0.5)), np.zeros(3))
    assert not own.sectors()


def test_a_profile_of_another_size_is_refused():
    with pytest.raises(ValueError, match=f"expected \\({BINS},\\)"):
        SelfReturns().restore(np.zeros(10))
