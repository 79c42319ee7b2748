import numpy as np
import pytest

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.local_trajectory_builder import exp_twist, twist
from beamsplat.services.localization.lidar2d.metrics import interpolate_poses
from beamsplat.services.localization.lidar2d.odometry import MotionErrorModel, OdometryBuffer, interpolate

NS = 1_000_000_000


def turning(times):
    """Return poses [N, 3] of a robot that drives with an oscillating heading."""
    return np.column_stack(
        [0.3 * times, 0.1 * np.sin(times), 0.8 * np.sin(1.3 * times) + 0.3 * np.sin(3.1 * times)]
    )


def test_interpolation_against_reference_code(rng):
    stamps = np.cumsum(rng.integers(10_000_000, 60_000_000, 50)).astype(np.int64)
    poses = np.column_stack([rng.normal(size=(50, 2)), se2.wrap_many(np.cumsum(rng.normal(size=50)))])
    out = np.empty(3)
    for at in rng.integers(stamps[0], stamps[-1], 40):
        assert interpolate(stamps, poses, int(at), 0, NS, out)
        expected = interpolate_poses(stamps, poses, np.array([at]))[0]
        assert np.allclose(out[:2], expected[:2])
        assert abs(se2.wrap(out[2] - expected[2])) < 1e-6
    assert not interpolate(stamps, poses, int(stamps[0]) - 1, 0, NS, out)
    assert not interpolate(stamps, poses, int(stamps[-1]) + 2, 1, NS, out)


@pytest.mark.parametrize("delay_s", [-0.12, 0.0, 0.15])
def test_the_delay_is_estimated(delay_s, rng):
    buffer, last = OdometryBuffer(), None
    for k in range(3000):  # odometry at 50 Hz with a delayed clock
        t = k * 0.02
        buffer.add(round(t * NS), *turning(np.array([t - delay_s]))[0])
        if k % 10 == 0 and t > 1.0:
            stamp, yaw = round((t - 0.5) * NS), turning(np.array([t - 0.5]))[0, 2]
            if last is not None:
                buffer.observe_rotation(last[0], stamp, yaw - last[1] + 0.003 * rng.standard_normal())
            last = (stamp, yaw)
    assert buffer.delay_ns / NS == pytest.approx(delay_s, abs=0.021)


def test_increments_across_gaps_and_beyond_the_end():
    buffer = OdometryBuffer()
    for k in range(10):
        buffer.add(k * NS // 10, 0.1 * k, 0.0, 0.0)
    assert np.allclose(buffer.increment(NS // 4, NS * 3 // 4), [0.5, 0, 0])
    assert np.allclose(buffer.increment(NS // 2, NS), [0.5, 0, 0])  # extrapolated by 0.1 s
    assert buffer.increment(NS // 2, 2 * NS) is None
    buffer.add(4 * NS, 2.0, 0.0, 0.0)  # messages were missing for 3 s
    assert np.allclose(buffer.increment(NS // 2, 4 * NS), [1.5, 0, 0])


def test_invalid_odometry_is_rejected_and_counted():
    buffer = OdometryBuffer()
    assert buffer.add(NS, 0, 0, 0)
    assert not buffer.add(NS, 1, 0, 0)
    assert not buffer.add(2 * NS, float("nan"), 0, 0)
    assert buffer.rejected == 2


def test_the_error_model_follows_the_recent_errors():
    accurate, wrong = (
        MotionErrorModel(0.01, 0.05, 0.02, 0.004, 0.05, 0.03),
        MotionErrorModel(0.01, 0.05, 0.02, 0.004, 0.05, 0.03),
    )
    truth = np.array([0.1, 0.0, 0.02])
    for _ in range(30):
        accurate.update(truth + np.array([0.002, 0, 0.001]), truth)
        wrong.update(-truth, truth)
    assert wrong.sigmas(truth, 0.1)[0] > 0.1  # decimetres
    assert accurate.sigmas(truth, 0.1)[0] < 0.01
    assert accurate.sigmas(truth, 3.0)[0] > accurate.sigmas(truth, 0.1)[0]  # less certain after a gap


def test_twist_and_its_exponential():
    for motion in ([0.3, -0.1, 0.8], [0.2, 0.05, 1e-5], [0.0, 0.0, -2.5]):
        assert np.allclose(exp_twist(twist(np.array(motion), 0.4), 0.4), motion, atol=1e-9)
