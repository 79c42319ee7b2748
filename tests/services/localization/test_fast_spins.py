"""Fast turns on the spot: 1.5 rad/s for 40 scans, by lidars of 5 and 10 Hz, with and without beam times."""

import numpy as np
import pytest

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from tests.services.localization.world import RayCastLidar

NS = 1_000_000_000
START_NS = 1_700_000_000 * NS
SPIN_RAD_S, SPIN_SCANS, RAMP_S, REST_S = 1.5, 40, 0.3, 1.0


class Spin:
    """A robot that rests, turns on the spot, and rests again."""

    def __init__(self, scans_hz: float) -> None:
        spin_s = SPIN_SCANS / scans_hz
        self.duration_s = 2.0 * REST_S + spin_s + 2.0 * RAMP_S
        self._t = np.arange(0.0, self.duration_s + 1.0, 0.002)
        ends = np.array([0.0, RAMP_S, RAMP_S + spin_s, 2.0 * RAMP_S + spin_s]) + REST_S
        rate = np.interp(self._t, ends, (0.0, SPIN_RAD_S, SPIN_RAD_S, 0.0))
        self._yaw = 0.3 + np.concatenate([[0.0], np.cumsum(rate[:-1] * 0.002)])

    def __call__(self, t):
        yaw = se2.wrap_many(np.interp(t, self._t, self._yaw))
        return np.column_stack([np.full(len(yaw), 2.0), np.full(len(yaw), 2.3), yaw])


def spin(lidar: RayCastLidar, rate_hz: float, reported: bool):
    """Return the statuses, and the errors of all poses float64 [N, 3] in metres and radians."""
    slam, drive = LidarSlam(LidarSlamSettings(), np.eye(4)), Spin(rate_hz)
    angle_min, increment, dt, low, high = lidar.arguments()
    statuses, poses, truth = [], [], []
    for t in np.arange(0.0, drive.duration_s, 1.0 / rate_hz):
        stamp_ns = START_NS + round(t * NS)
        result = slam.add_scan(
            stamp_ns, lidar.scan(drive, t), angle_min, increment, dt if reported else 0.0, low, high
        )
        if result.job is not None:
            slam.apply(result.job.run())
        statuses.append(result.status)
        poses.append(result.pose_odom_body)
        truth.append(drive(np.array([t]))[0])
    truth = np.array(truth)
    return statuses, se2.between_many(truth, se2.compose_many(truth[0], np.array(poses)))


@pytest.mark.parametrize("rate_hz", [5.0, 10.0])
@pytest.mark.parametrize(
    ("sweep", "reported", "error_m", "error_rad"),
    [
        # The robot starts and stops with 5 rad/s^2: the first scan of a ramp is skewed by an unknown rate.
        (True, True, 0.04, 0.12),
        (False, True, 0.03, 0.01),
        # The scans are skewed by up to 17 degrees and nothing tells so: the pose only stays on the map.
        (True, False, 0.15, 0.25),
    ],
    ids=["beam times", "all beams at once", "beam times not reported"],
)
def test_the_pose_survives_a_fast_spin(rate_hz, sweep, reported, error_m, error_rad):
    lidar = RayCastLidar(beams=360, rate_hz=rate_hz, seed=1, sweep=sweep)
    statuses, errors = spin(lidar, rate_hz, reported)
    assert set(statuses) == {"ok"}
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < error_m
    assert np.abs(errors[:, 2]).max() < error_rad
    assert abs(errors[-1, 2]) < 0.02
    if reported:  # at a constant rate
        steady = slice(
            round(rate_hz * (REST_S + RAMP_S + 1.0)), round(rate_hz * (REST_S + RAMP_S)) + SPIN_SCANS
        )
        assert np.sqrt(np.mean(errors[steady, 2] ** 2)) < 0.01
