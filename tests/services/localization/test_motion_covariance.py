"""The stated covariance of the motion over a second agrees with the true errors of simulated drives."""

import numpy as np
import pytest

from beamsplat.common.geometry.trajectory import Trajectory
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.services.localization.lidar2d.motion_covariance import motion_covariance
from beamsplat.services.localization.lidar2d.scan_matching import Match
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.tools.bench.uncertainties import motion_samples
from tests.services.localization.test_slam import SETTINGS, run
from tests.services.localization.world import RayCastLidar, SimulatedDrive, wheels


def test_the_normalised_error_of_a_deck_of_drives_is_between_07_and_15():
    errors, sigmas = [], []
    for seed, (noise_m, speed_m_s) in enumerate([(0.005, 0.4), (0.01, 0.6), (0.02, 0.4)]):
        drive, lidar = SimulatedDrive(speed_m_s), RayCastLidar(720, sigma_m=noise_m, seed=seed)
        odometry = wheels(drive, np.arange(0, drive.duration_s, 0.02), scale=(0.98, 1.02, 1.02)[seed])
        results, truth = run(LidarSlam(SETTINGS, np.eye(4)), drive, lidar, odometry=odometry)
        stamps_ns = np.array([r.stamp_ns for r in results])
        samples = motion_samples(results, Trajectory(stamps_ns, se2_to_se3(truth)))
        errors.append(samples[0])
        sigmas.append(samples[1])
    # About 100 independent seconds: a statistical width of 7 %.
    normalised = np.sqrt(np.mean((np.concatenate(errors) / np.concatenate(sigmas)) ** 2, axis=0))
    assert np.all(normalised > 0.7 / 1.07), normalised
    assert np.all(normalised < 1.5 * 1.07), normalised


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0])
def test_the_axes_of_the_covariance_are_those_of_odom(yaw_deg):
    # A corridor along the x axis of the submap leaves x of the submap uncertain.
    match = Match(np.zeros(3), np.diag([1e2, 1e6, 1e8]), 1.0, 1.0, 0.01)
    covariance = motion_covariance(match, np.radians(yaw_deg), [0], [np.zeros(3)], LidarSlamSettings())
    uncertain = 0 if yaw_deg == 0.0 else 1
    assert covariance[uncertain, uncertain] > 100.0 * covariance[1 - uncertain, 1 - uncertain]
