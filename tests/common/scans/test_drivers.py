"""What the drivers of robots that people own publish is read as what their lidars measured."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from beamsplat.common.recording.input_report import InputReport
from beamsplat.common.scans.reader import ScanReader
from beamsplat.services.localization.lidar2d.job_runner import JobRunner
from beamsplat.services.localization.lidar2d.metrics import trajectory_errors
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from tests.common.scans.robots import DRIVERS, START_NS, Drive, odometry, oradar_ms200, sweeps

QUICK = ("sllidar_ros2", "ldlidar_stl_ros2", "ld08_driver", "rplidar_mirrored", "negative_time")
COUNTER_CLOCKWISE = ("turtlebot3_slow", "eaibot", "negative_time", "no_time")


@pytest.fixture(scope="module")
def drive():
    """A drive with a spin of 1 rad/s to each side."""
    return Drive()


@pytest.fixture(scope="module")
def recorded(drive):
    """Ideal clockwise and counter-clockwise messages of one drive, and its wheel odometry."""
    return sweeps(drive, beams=160, clockwise=True), sweeps(drive, beams=160), odometry(drive)


def learn(messages, wheels):
    """The fields of all scans, the report and the reader."""
    report = InputReport()
    reader = ScanReader("/scan", report)
    reader.set_mount(np.eye(4))
    merged = [(m.at_ns, 0, m) for m in messages] + [(o[0], 1, o) for o in wheels]
    reader.learn(entry for _, _, entry in sorted(merged, key=lambda item: item[:2]))
    return [fields for message in messages for fields in reader.read(message)], report, reader


def measured(fields):
    """Per beam: direction in -pi..pi (rad), time (s since the start), range (m), in the order of directions."""
    index = np.arange(len(fields["ranges_m"]))
    angles = fields["angle_min_rad"] + fields["angle_increment_rad"] * index
    times = (fields["stamp_ns"] - START_NS) / 1e9 + fields["time_increment_s"] * index
    return np.angle(np.exp(1j * angles)), times, fields["ranges_m"].astype(np.float64)


def compare(read, ideal):
    """Largest differences of direction (rad) and time (s) of the beams with the same range."""
    directions, times = [], []
    for one, other in zip(read[::20], ideal[::20]):
        a, t, r = measured(one)
        b, s, q = measured(other)
        order = {round(float(value), 6): i for i, value in enumerate(q) if np.isfinite(value)}
        pairs = [(i, order[round(float(v), 6)]) for i, v in enumerate(r) if round(float(v), 6) in order]
        assert len(pairs) > 0.9 * len(order)
        for i, j in pairs:
            directions.append(abs(math.remainder(a[i] - b[j], 2.0 * math.pi)))
            times.append(abs(t[i] - s[j]))
    return max(directions), max(times)


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in DRIVERS]
)
def test_beams_get_the_direction_and_the_time_of_their_measurement(recorded, name):
    clockwise, counter_clockwise, wheels = recorded
    ideal = counter_clockwise if name in COUNTER_CLOCKWISE else clockwise
    published = [DRIVERS[name](message, k) for k, message in enumerate(ideal)]
    read, report, reader = learn(published, wheels)
    truth = [ScanReader("", InputReport(), as_stated=True).read(message)[0] for message in ideal]
    assert len(read) == len(truth)
    direction_rad, time_s = compare(read, truth)
    # sllidar_ros2 and those that lose a beam state directions that are up to a beam off.
    assert direction_rad < 1.05 * 2.0 * math.pi / 160
    assert time_s < 0.009
    # A reversed, mirrored or untimed driver is named; what the messages state correctly is not.
    assert (report.sentences != []) == (name != "negative_time_true")
    assert all("/scan: 159 messages repaired: " in sentence for sentence in report.sentences)
    assert reader.warnings == []


def test_ideal_drivers_are_confirmed_and_not_changed(recorded):
    for messages in recorded[:2]:
        read, report, reader = learn(messages, recorded[2])
        truth = [ScanReader("", InputReport(), as_stated=True).read(message)[0] for message in messages]
        assert compare(read, truth) == (0.0, 0.0)
        assert report.sentences == reader.warnings == []
        assert "pairs of sweeps at up to 5" in reader.learner.evidence()


def test_a_lidar_that_measures_all_beams_at_once_is_not_deskewed(drive):
    """MRPT/mvsim #98: simulated in one shot; here with a time_increment as of a turning lidar."""
    messages = [
        replace(message, time_increment_s=0.1 / 160) for message in sweeps(drive, beams=160, at_once=True)
    ]
    read, report, _ = learn(messages, odometry(drive))
    assert {fields["time_increment_s"] for fields in read} == {0.0}
    assert "all beams at once" in report.sentences[0]


def slam_error_m(fields, wheels, drive):
    """Largest of the position RMSE (m) of the published and of the optimised trajectory."""
    slam = LidarSlam(LidarSlamSettings(), np.eye(4))
    events = [(stamp_ns, 0, pose) for stamp_ns, pose in wheels] + [(f["stamp_ns"], 1, f) for f in fields]
    with JobRunner(slam) as jobs:
        for stamp_ns, kind, value in sorted(events, key=lambda event: event[:2]):
            if kind == 0:
                slam.add_odometry(stamp_ns, *value)
                continue
            jobs.before_scan()
            jobs.after_scan(
                slam.add_scan(
                    stamp_ns, value["ranges_m"], value["angle_min_rad"], value["angle_increment_rad"],
                    value["time_increment_s"], value["range_min_m"], value["range_max_m"],
                )
            )  # fmt: skip
        jobs.finish()
    stamps, optimised, online = slam.trajectory()
    truth = drive((stamps - START_NS) * 1e-9)
    return max(trajectory_errors(poses, truth).ate_first_pose_rmse_m for poses in (optimised, online))


@pytest.mark.slow
def test_the_pose_error_on_a_spinning_robot_is_that_of_the_ideal_driver(recorded, drive):
    clockwise, counter_clockwise, wheels = recorded
    clean_m = {
        id(ideal): slam_error_m(learn(ideal, wheels)[0], wheels, drive)
        for ideal in (clockwise, counter_clockwise)
    }
    published = {
        name: [
            driver(message, k)
            for k, message in enumerate(counter_clockwise if name in COUNTER_CLOCKWISE else clockwise)
        ]
        for name, driver in DRIVERS.items()
    }
    published["oradar_ms200"] = oradar_ms200(clockwise)
    for name, messages in published.items():
        ideal = counter_clockwise if name in COUNTER_CLOCKWISE else clockwise
        read, _, _ = learn(messages, wheels)
        # The receive time stands in for stamps of the end of a scan, which is up to 7 ms later.
        assert slam_error_m(read, wheels, drive) <= max(1.2 * clean_m[id(ideal)], 0.004), name
