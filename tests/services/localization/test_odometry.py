import numpy as np
import pytest

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.local_trajectory_builder import exp_twist, twist
from beamsplat.services.localization.lidar2d.metrics import interpolate_poses
from beamsplat.services.localization.lidar2d.odometry import MotionErrorModel, OdometryBuffer, interpolate

NS = 1_000_000_000


def turning(times):
    """A robot that sways while it drives."""
    return np.column_stack(
        [0.3 * times, 0.1 * np.sin(times), 0.8 * np.sin(1.3 * times) + 0.3 * np.sin(3.1 * times)]
    )


def test_interpolation_against_a_slow_twin(rng):
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
def test_the_delay_is_found(delay_s, rng):
    buffer, last = OdometryBuffer(), None
    for k in range(3000):  # odometry at 50 Hz whose clock is off
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
    assert np.allclose(
        buffer.increment(NS // 2, NS), [0.5, 0, 0]
    )  # the last velocity, a tenth of a second on
    assert buffer.increment(NS // 2, 2 * NS) is None
    buffer.add(4 * NS, 2.0, 0.0, 0.0)  # the wheels kept counting during three silent seconds
    assert np.allclose(buffer.increment(NS // 2, 4 * NS), [1.5, 0, 0])


def test_bad_odometry_is_refused_and_counted():
    buffer = OdometryBuffer()
    assert buffer.add(NS, 0, 0, 0)
    assert not buffer.add(NS, 1, 0, 0)
    assert not buffer.add(2 * NS, float("nan"), 0, 0)
    assert buffer.rejected == 2


def test_a_lying_predictor_loses_its_say():
    honest, liar = (
        MotionErrorModel(0.01, 0.05, 0.02, 0.004, 0.05, 0.03),
        MotionErrorModel(0.01, 0.05, 0.02, 0.004, 0.05, 0.03),
    )
    truth = np.array([0.1, 0.0, 0.02])
    for _ in range(30):
        honest.update(truth + np.array([0.002, 0, 0.001]), truth)
        liar.update(-truth, truth)
    assert liar.sigmas(truth, 0.1)[0] > 0.1  # it says so itself: decimetres
    assert honest.sigmas(truth, 0.1)[0] < 0.01
    assert honest.sigmas(truth, 3.0)[0] > honest.sigmas(truth, 0.1)[0]  # nothing is certain after a gap


def test_twist_and_its_exponential():
    for motion in ([0.3, -0.1, 0.8], [0.2, 0.05, 1e-5], [0.0, 0.0, -2.5]):
        assert np.allclose(exp_twist(twist(np.array(motion), 0.4), 0.4), motion, atol=1e-9)
