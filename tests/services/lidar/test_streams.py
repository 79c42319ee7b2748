"""Each lidar's stream at full rate, undamaged and with 1 % wrong bytes, compared with the room's walls."""

import numpy as np
import pytest

from beamsplat.services.lidar.clock import CounterUnwrapper, DeviceClock
from beamsplat.services.lidar.hokuyo import HokuyoDriver
from beamsplat.services.lidar.ldrobot import LdrobotDriver
from beamsplat.services.lidar.range_filter import LinkNoise, confirmed_ranges
from beamsplat.services.lidar.rplidar import RplidarDriver
from tests.services.lidar.devices import Hokuyo, Ld19, Rplidar
from tests.services.lidar.links import range_errors_m, run_device

# name: driver, device, beams per revolution, revolutions/s, allowed error (m): half an angle step on these walls
KINDS = {
    "ld19": (LdrobotDriver, Ld19, 450, 10.0, 0.01),
    "rplidar a1 express": (RplidarDriver, Rplidar, 727, 5.5, 0.04),
    "rplidar a1 standard": (
        lambda: RplidarDriver("standard"),
        lambda: Rplidar(0x82, 0x18, 2000.0),
        364,
        5.5,
        0.01,
    ),
    "rplidar c1 dense": (RplidarDriver, lambda: Rplidar(0x85, 0x41, 5000.0, 10.0), 500, 10.0, 0.01),
    "rplidar a3 ultra": (RplidarDriver, lambda: Rplidar(0x84, 0x31, 16000.0, 10.0), 1600, 10.0, 0.04),
    "rplidar s1 hq": (RplidarDriver, lambda: Rplidar(0x83, 0x61, 9200.0, 10.0), 920, 10.0, 0.01),
    "hokuyo ust-10lx": (HokuyoDriver, Hokuyo, 1081, 40.0, 0.01),
}


@pytest.mark.parametrize("kind", KINDS)
def test_clean_stream(kind):
    make, device, beams, turn_hz, allowed = KINDS[kind]
    driver = make()
    scans = run_device(driver, device(), 3.0)
    assert len(scans) >= 0.95 * 3.0 * turn_hz - 2
    errors = range_errors_m(scans)
    assert errors.max() < allowed
    assert len(errors) / len(scans) == pytest.approx(beams, rel=0.01)
    turn = scans[-1].revolution
    sign = 1.0 if kind.startswith("hokuyo") else -1.0
    assert np.sign(turn.angle_increment_rad) == sign  # the order of measurement is kept
    per_turn = 1440 if sign > 0 else beams
    assert turn.time_increment_s * turn_hz * per_turn == pytest.approx(1.0, rel=0.01)
    assert turn.scan_time_s * turn_hz == pytest.approx(1.0, rel=0.02)
    assert driver.counters.bad_packets == 0
    assert not driver.noise.noisy or kind == "rplidar a1 standard"


@pytest.mark.parametrize("kind", KINDS)
def test_stamps_are_measurement_times(kind):
    """Packets are delayed by 3 ms on average; the stamps must not vary with the delay."""
    make, device, _, turn_hz, _ = KINDS[kind]
    scans = run_device(make(), device(), 6.0, seed=3)
    stamps = np.array([s.stamp_ns for s in scans[5:]])
    assert np.diff(front_times(scans[5:])) * 1e3 == pytest.approx(1e3 / turn_hz, abs=1.5)
    assert np.diff(stamps).min() > 0
    phase = front_times(scans[5:]) * turn_hz
    if not kind.startswith("hokuyo"):  # its emulated front lies elsewhere in the turn
        assert np.abs(phase - np.round(phase)).max() / turn_hz < 0.006


def front_times(scans):
    """Return when the device measured its front direction (s); the emulated clock starts at 1000 s, at
    the front.
    """
    found = []
    for scan in scans:
        turn = scan.revolution
        turned = turn.angle_min_rad / turn.angle_increment_rad  # beams since the front
        found.append(scan.stamp_ns / 1e9 - 1000.0 - turned * turn.time_increment_s)
    return np.array(found)


@pytest.mark.parametrize("kind", [k for k in KINDS if "hq" not in k])
def test_one_byte_in_a_hundred_wrong(kind):
    make, device, beams, turn_hz, _ = KINDS[kind]
    driver = make()
    scans = run_device(driver, device(), 6.0, corruption=0.01, seed=1)
    # Three of four ultra capsules (132 bytes) have a wrong byte then; of others about half.
    assert len(scans) > (0.25 if "ultra" in kind else 0.8) * 6.0 * turn_hz
    assert driver.noise.noisy
    errors = range_errors_m(scans)
    # Undetected wrong ranges agree with their neighbours to 2 cm + 0.5 %.
    assert errors.max() < (0.10 if "standard" in kind else 0.06)
    assert len(errors) > (0.1 if "ultra" in kind else 0.2) * beams * len(scans)
    measured_or_lost = len(errors) + driver.counters.lost_samples
    if "ultra" not in kind:
        assert measured_or_lost == pytest.approx(beams * 6.0 * turn_hz, rel=0.2)
    stamps = np.array([s.stamp_ns for s in scans])
    assert np.diff(stamps).min() > 0
    turns = np.diff(front_times(scans[8:])) * turn_hz
    assert np.abs(turns - np.round(turns)).max() < 0.08


def test_hq_at_a_wrong_byte_in_a_thousand():
    """Packets have 781 bytes: with 1 % wrong bytes none would be undamaged."""
    make, device, beams, *_ = KINDS["rplidar s1 hq"]
    driver = make()
    scans = run_device(driver, device(), 6.0, corruption=0.001, seed=1)
    assert range_errors_m(scans).max() < 0.01
    assert len(range_errors_m(scans)) > 0.2 * beams * len(scans) > 0
    assert driver.counters.bad_packets > 100


@pytest.mark.parametrize("kind", ["ld19", "rplidar c1 dense"])
def test_lost_bytes_cost_a_few_packets(kind):
    make, device, beams, _, _ = KINDS[kind]
    driver, device = make(), device()

    class Dropping:
        def __init__(self):
            self.rng = np.random.default_rng(0)

        def __getattr__(self, name):
            return getattr(device, name)

        def packet(self):
            data = bytearray(device.packet())
            if self.rng.random() < 0.01:
                del data[self.rng.integers(len(data))]
            return bytes(data)

    scans = run_device(driver, Dropping(), 5.0)
    assert range_errors_m(scans).max() < 0.06
    assert len(range_errors_m(scans)) > 0.6 * beams * len(scans) > 0
    assert driver.counters.skipped_bytes > 0


def test_chunk_size_does_not_change_the_result():
    whole = run_device(LdrobotDriver(), Ld19(), 1.0)
    pieces = run_device(LdrobotDriver(), Ld19(), 1.0, chunk=7)
    assert len(whole) == len(pieces) > 5
    for a, b in zip(whole, pieces):
        assert np.array_equal(a.revolution.range_m, b.revolution.range_m, equal_nan=True)


def test_a_device_without_modes_gets_no_mode_request():
    device = Rplidar()
    run_device(RplidarDriver(), device, 0.5)
    assert device.requests == [bytes.fromhex(x) for x in ("A525", "A550", "A552", "A58205000000000022")]


def test_device_clock_uses_the_least_delayed_packets_and_rejects_wrong_times():
    rng = np.random.default_rng(0)
    clock = DeviceClock()
    for i in range(2000):
        device_s = i * 0.00267
        arrival_ns = int((50.0 + device_s * (1.0 + 5e-5) + rng.exponential(0.004)) * 1e9)  # 50 ppm apart
        if i % 100 == 50:
            assert not clock.update(device_s + 7.0, arrival_ns)  # a wrong byte in its time
        else:
            assert clock.update(device_s, arrival_ns)
    stamp = clock.stamp_ns(2000 * 0.00267)
    assert stamp / 1e9 == pytest.approx(50.0 + 2000 * 0.00267 * (1.0 + 5e-5), abs=0.001)
    assert clock.stamp_ns(0.0) == stamp + 1  # never backwards
    for i in range(8):  # a device with another clock
        clock.update(1000.0 + i, int((60.0 + i) * 1e9))
    assert clock.stamp_ns(1008.0) / 1e9 == pytest.approx(68.0, abs=0.001)


def test_counters_are_unwrapped():
    unwrap = CounterUnwrapper(30000, 1e3)
    times = [unwrap(t % 30000, t * 1_000_000) for t in range(29000, 200_000, 500)]
    assert np.diff(times).tolist() == [500] * (len(times) - 1)
    unwrap(12345, 200_000_000_000)  # one wrong value
    assert unwrap(200_500 % 30000, 200_500_000_000) == times[0] + 200_500 - 29000


def test_unconfirmed_ranges_are_rejected():
    noise = LinkNoise()
    for i in range(100):
        noise.update(i % 20 != 0)
    assert noise.noisy
    angle = np.radians(np.arange(-40, 41))
    wall = 2.0 / np.cos(angle)
    nothing = np.full(81, np.nan)
    assert confirmed_ranges(wall, nothing).all()  # at the ends by neighbours on one side
    twisted = wall.copy()
    twisted[50], twisted[52] = wall[50] - 0.4, wall[52] + 0.4  # one bit of two bytes, up and down
    assert not confirmed_ranges(twisted, nothing)[[50, 52]].any()
    wrong = wall.copy()
    wrong[[30, 31]] += 0.5  # two neighbours wrong by the same amount
    assert not confirmed_ranges(wrong, nothing)[[30, 31]].any()
    assert not confirmed_ranges(wrong, wall)[[30, 31]].any()
    post = wall.copy()
    post[40] = 1.0  # a chair leg, also seen one revolution before
    assert not confirmed_ranges(post, nothing)[40]
    assert confirmed_ranges(post, post)[40]
