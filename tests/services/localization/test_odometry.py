import numpy as np
import pytest

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.metrics import interpolate_poses
from beamsplat.services.localization.lidar2d.odometry import MotionErrorModel, OdometryBuffer, interpolate
from beamsplat.services.localization.lidar2d.twist import exp_twist, twist

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


def observed(distort, rng, seconds=60.0, delay_s=0.0):
    """Return a buffer that has compared distorted odometry (50 Hz) with the motion by scans (5 Hz)."""
    buffer = OdometryBuffer()
    ticks = np.arange(0.0, seconds, 0.02)
    truth = turning(ticks)
    poses = [np.zeros(3)]
    for t, step in zip(ticks, se2.between_many(truth[:-1], truth[1:])):
        poses.append(se2.compose(poses[-1], distort(t, step)))
    last = None
    for k, (t, pose) in enumerate(zip(ticks, poses)):
        buffer.add(round((t + delay_s) * NS), *pose)
        if k % 10 == 0 and t > 1.0:
            stamp, now = round((t - 0.5) * NS), turning(np.array([t - 0.5]))[0]
            if last is not None:
                noise = rng.normal(0.0, (0.002, 0.002, 0.002))
                buffer.observe(last[0], stamp, se2.between(last[1], now) + noise)
            last = (stamp, now)
    return buffer


@pytest.mark.parametrize("delay_s", [-0.12, 0.0, 0.16, 0.64])
def test_the_delay_is_estimated(delay_s, rng):
    # The wheels also turn too much, which must not look like a delay.
    buffer = observed(lambda t, step: step * (1.0, 1.0, 1.1), rng, delay_s=delay_s)
    assert buffer.delay_ns / NS == pytest.approx(delay_s, abs=0.021)


@pytest.mark.parametrize(("scale", "turn"), [(1.1, 1.0), (0.97, 0.96), (-1.0, 1.0)])
def test_the_scales_are_estimated_and_corrected(scale, turn, rng):
    buffer = observed(lambda t, step: step * (scale, scale, turn), rng)
    report = buffer.report()
    assert report.used
    assert abs(report.distance_scale - 1.0 / scale) < min(0.01, 4.0 * report.distance_scale_sigma)
    assert abs(report.turn_scale - 1.0 / turn) < min(0.02, 4.0 * report.turn_scale_sigma)
    assert bool(report.text) == (abs(scale - 1.0) > 0.05)
    truth = turning(np.array([30.0, 31.0]))
    error = se2.between(se2.between(*truth), buffer.increment(30 * NS, 31 * NS))
    assert np.hypot(error[0], error[1]) < 0.01


def test_slip_is_counted_and_does_not_change_the_scale(rng):
    buffer = observed(lambda t, step: step * (1.6 if 20.0 < t % 25.0 < 22.0 else 1.0, 1.0, 1.0), rng)
    report = buffer.report()
    assert abs(report.distance_scale - 1.0) < 0.01
    assert report.used
    assert 1 <= report.disagreeing <= 6


def test_odometry_without_a_constant_scale_is_not_used(rng):
    # Wheels without a sign on a robot that moves back and forth.
    buffer = observed(lambda t, step: step * (1.0 if t % 4.0 < 2.0 else -1.0, 1.0, 1.0), rng)
    report = buffer.report()
    assert not report.used
    assert "not used" in report.text


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


def test_a_stamp_from_the_future_does_not_silence_the_wheels():
    buffer, ticks = OdometryBuffer(), np.arange(0.0, 4.0, 0.02)
    for k, (t, pose) in enumerate(zip(ticks, turning(ticks))):
        stamp_ns = int(t * NS) + (3600 * NS if k == 100 else 0)
        buffer.add(stamp_ns, *pose)
    assert buffer.rejected == 4
    moved = buffer.increment(int(3.0 * NS), int(3.5 * NS))
    assert moved == pytest.approx(se2.between(*turning(np.array([3.0, 3.5]))), abs=2e-3)


@pytest.mark.parametrize("repeated_s", [0.0, 5.0], ids=["clock set back", "played again"])
def test_the_wheels_tell_the_motion_over_stamps_that_go_back(repeated_s):
    """The clock goes back by an hour, or a recording is played again from 5 s earlier: there the robot was."""
    buffer, end_s = OdometryBuffer(), 10.0
    back_ns = 3600 * NS if repeated_s == 0.0 else 0
    before, after = np.arange(0.0, end_s, 0.02), np.arange(end_s - repeated_s, end_s - repeated_s + 1.0, 0.02)
    for t, pose in zip(before, turning(before)):
        buffer.add(int(t * NS) + back_ns, *pose)
    for t, pose in zip(after, turning(after)):
        buffer.add(int(t * NS), *pose)
    at_s = end_s - repeated_s + 0.5
    moved = buffer.motion_over_set_back(int(9.9 * NS) + back_ns, int(at_s * NS))
    assert moved == pytest.approx(se2.between(*turning(np.array([9.9, at_s]))), abs=5e-3)
    assert OdometryBuffer().motion_over_set_back(0, NS) is None


def test_wheels_of_the_old_time_are_not_motion_of_the_new_time():
    """The scans' clock has gone back by 5 s; the wheels of the new time come later, one of the old time too."""
    buffer, before, after = OdometryBuffer(), np.arange(0.0, 10.0, 0.02), np.arange(5.0, 7.0, 0.02)
    poses = turning(before)
    for t, pose in zip(before[:-1], poses):
        buffer.add(int(t * NS), *pose)
    buffer.clock_set_back(int(9.9 * NS), int(5.0 * NS))
    assert buffer.increment(int(5.0 * NS), int(5.5 * NS)) is None
    assert buffer.motion_over_set_back(int(9.9 * NS), int(5.5 * NS)) is None
    buffer.add(int(before[-1] * NS), *poses[-1])
    assert buffer.increment(int(5.0 * NS), int(5.5 * NS)) is None
    for t, pose in zip(after, turning(after)):
        buffer.add(int(t * NS), *pose)
    moved = buffer.motion_over_set_back(int(9.9 * NS), int(6.0 * NS))
    assert moved == pytest.approx(se2.between(*turning(np.array([9.9, 6.0]))), abs=5e-3)
    assert buffer.increment(int(6.0 * NS), int(6.5 * NS)) == pytest.approx(
        se2.between(*turning(np.array([6.0, 6.5]))), abs=5e-3
    )


def test_wheels_that_began_again_at_zero_tell_no_motion_over_a_clock_set_back():
    buffer, ticks = OdometryBuffer(), np.arange(0.0, 10.0, 0.02)
    for t, pose in zip(ticks, turning(ticks)):
        buffer.add(int(t * NS) + 3600 * NS, *pose)
    driven_s = np.maximum(ticks[:100] - 0.3, 0.0)  # it stands at first
    for t, pose in zip(ticks, turning(driven_s) - turning(driven_s[:1])):
        buffer.add(int(t * NS), *pose)
    assert buffer.motion_over_set_back(int(9.9 * NS) + 3600 * NS, int(1.0 * NS)) is None
