"""Wheels over a stretch without scans: their motion is corrected, and its stated error is the true one."""

import numpy as np
import pytest

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.odometry_calibration import OdometryCalibration
from beamsplat.services.localization.lidar2d.wheel_gap import motion_over_gap

STEP_S = 0.1


def _drive(rng, metres, scale, bend_rad_per_m, noise_rad):
    """Return the true motions and those by the wheels, float64 [N, 3] each, of a winding drive at 0.8 m/s."""
    n = round(metres / (0.8 * STEP_S))
    rate = 0.5 * np.sin(0.3 * STEP_S * np.arange(n) + rng.uniform(0.0, 6.0)) + rng.normal(0.0, 0.1, n)
    turn = rate * STEP_S
    true = np.column_stack([np.full(n, 0.8 * STEP_S), np.zeros(n), turn])
    wheels = true.copy()
    wheels[:, 0] *= scale
    wheels[:, 2] -= bend_rad_per_m * true[:, 0] + noise_rad * np.sqrt(true[:, 0]) * rng.normal(0.0, 1.0, n)
    return true, wheels


def _chain(motions):
    poses = [np.zeros(3)]
    for motion in motions:
        poses.append(se2.compose(poses[-1], motion))
    return np.array(poses)


def _gap(seed, silent):
    """Return the error [3] of the motion over a gap of 25 m after 150 m of driving, and its deviations."""
    rng = np.random.default_rng(seed)
    scale, bend, noise = rng.normal(1.0, 0.02), rng.normal(0.0, 0.006), abs(rng.normal(0.0, 0.01))
    calibration = OdometryCalibration()
    for true, wheels in zip(*_drive(rng, 150.0, scale, bend, noise)):
        calibration.observe(wheels, true + rng.normal(0.0, [0.002, 0.002, 0.001]), STEP_S)
    true, wheels = _drive(rng, 25.0, scale, bend, noise)
    poses, intervals = _chain(wheels), np.full(len(wheels), STEP_S)
    if silent:
        poses, intervals = poses[[0, -1]], np.array([intervals.sum()])
    gap = motion_over_gap(poses, intervals, 0.6, calibration)
    return se2.between(_chain(true)[-1], gap.motion), gap.sigma_m, gap.sigma_rad


@pytest.mark.parametrize("silent", [False, True])
def test_the_stated_error_over_a_gap_is_the_true_one(silent):
    """Over 60 robots, each with its own wheels: neither too sure, nor three times too cautious."""
    found = [_gap(seed, silent) for seed in range(60)]
    normalised_m = np.array([np.hypot(e[0], e[1]) / m for e, m, _ in found])
    normalised_rad = np.array([e[2] / rad for e, _, rad in found])
    assert 0.3 < np.sqrt((normalised_m**2).mean()) < 1.2
    assert 0.4 < np.sqrt((normalised_rad**2).mean()) < 1.3
    assert np.quantile(np.abs(normalised_rad), 0.95) < 3.0


def test_a_constant_turn_of_the_wheels_is_corrected():
    """Wheels that turn by half a degree per metre miss a straight 25 m by 2.7 m; corrected, by 0.3 m."""
    rng = np.random.default_rng(1)
    bend = np.radians(0.5)
    calibration = OdometryCalibration()
    for true, wheels in zip(*_drive(rng, 150.0, 1.0, bend, 0.002)):
        calibration.observe(wheels, true, STEP_S)
    assert calibration.heading.turn_rad_per_m == pytest.approx(bend, abs=0.0008)
    true, wheels = _drive(rng, 25.0, 1.0, bend, 0.002)
    gap = motion_over_gap(_chain(wheels), np.full(len(wheels), STEP_S), 0.6, calibration)
    error = se2.between(_chain(true)[-1], gap.motion)
    assert np.hypot(error[0], error[1]) < 0.3
    assert gap.sigma_m < 0.6


def test_wheels_that_are_not_known_yet_are_trusted_little():
    gap = motion_over_gap(_chain(np.array([[20.0, 0.0, 0.0]])), np.array([30.0]), 0.6, OdometryCalibration())
    assert gap.sigma_rad > np.radians(10.0)
    assert gap.sigma_m > 2.0
