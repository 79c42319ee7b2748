"""Scans, transforms and clocks as people record them: the right result, or one sentence that names the cause.

Each case is a public report (../shared/cases lists them); the bags are built here. A property test changes each
field of LaserScan and of the lidar's transform: never a wrong scan without a sentence.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.rig import load_rig
from beamsplat.services.replay.inspection import inspect
from beamsplat.services.replay.open import open_recording
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.rig_draft import draft_from_data
from tests.common.scans.robots import START_NS, Drive, odometry, oradar_ms200, sllidar_ros2, sweeps
from tests.services.replay.make_bags import RobotBag

BEAMS = 90


def replace(message, **changes):
    return dataclasses.replace(message, **changes)


class Bench:
    """Writes the messages of one drive, each as a function changes it, into a bag."""

    def __init__(self, path, *, mount=(0.0, 0.0, 0.0, 1.0)) -> None:
        self.path = path
        self.bag = RobotBag(path, "mcap")
        self.mount = mount

    def quaternion(self, values):
        return self.bag.new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, values))))

    def scan(self, laser):
        n = {
            "angle_min": laser.angle_min_rad, "angle_max": laser.angle_max_rad,
            "angle_increment": laser.angle_increment_rad, "time_increment": laser.time_increment_s,
            "scan_time": laser.scan_time_s, "range_min": laser.range_min_m, "range_max": laser.range_max_m,
        }  # fmt: skip
        return self.bag.new(
            "sensor_msgs/msg/LaserScan", header=self.bag.header(laser.stamp_ns, laser.frame_id),
            ranges=laser.ranges_m, intensities=np.zeros(0, np.float32), **n,
        )  # fmt: skip

    def odometry(self, stamp_ns, pose):
        T = np.eye(4)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        T[:2, :2], T[:2, 3] = [[c, -s], [s, c]], pose[:2]
        twist = self.bag.new(
            "geometry_msgs/msg/Twist", linear=self.bag.vector([0, 0, 0]), angular=self.bag.vector([0, 0, 0])
        )
        return self.bag.new(
            "nav_msgs/msg/Odometry", header=self.bag.header(stamp_ns, "odom"), child_frame_id="base_link",
            pose=self.bag.new("geometry_msgs/msg/PoseWithCovariance", pose=self.bag.pose(T), covariance=np.zeros(36)),
            twist=self.bag.new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip

    def transforms(self, edges):
        """`edges`: (parent, child, xyz, quaternion xyzw)."""
        made = [
            self.bag.new(
                "geometry_msgs/msg/TransformStamped", header=self.bag.header(START_NS, parent), child_frame_id=child,
                transform=self.bag.new(
                    "geometry_msgs/msg/Transform", translation=self.bag.vector(xyz), rotation=self.quaternion(quat)
                ),
            )
            for parent, child, xyz, quat in edges
        ]  # fmt: skip
        return self.bag.new("tf2_msgs/msg/TFMessage", transforms=made)

    def write(
        self,
        lasers,
        wheels,
        change=lambda row: [row],
        edges=(),
        names=("/scan", "/odom", "/tf_static"),
        others=(),
    ):
        """`others`: rows (topic, message, receive time in ns) besides transforms, scans and odometry."""
        edges = edges or [("base_link", "laser", (0.0, 0.0, 0.18), self.mount)]
        rows = [(names[2], self.transforms(edges), START_NS)]
        rows += [(names[0], self.scan(laser), laser.at_ns) for laser in lasers]
        rows += [(names[1], self.odometry(stamp, pose), stamp + 2_000_000) for stamp, pose in wheels]
        rows += others
        changed = sorted((r for row in rows for r in change(row)), key=lambda row: row[2])
        with self.bag.writer:
            for topic, message, at_ns in changed:
                self.bag.write(topic, message, at_ns)
        return self.path


@pytest.fixture(scope="module")
def drive():
    return Drive(seconds=13.0)


@pytest.fixture(scope="module")
def clean(drive):
    """Ideal scans and wheel odometry of a drive with two spins."""
    return sweeps(drive, beams=BEAMS), odometry(drive)


def on(topic, function):
    """A change of the messages of one topic."""
    return lambda row: [(row[0], function(row[1]), row[2])] if row[0] == topic else [row]


def scan(**changes):
    """A change of fields of LaserScan: values, or functions of the message."""
    return on("/scan", lambda m: replace(m, **{k: v(m) if callable(v) else v for k, v in changes.items()}))


def stamped(function):
    def change(m):
        stamp = m.header.stamp
        ns = int(function(int(stamp.sec) * 10**9 + int(stamp.nanosec)))
        return replace(m, header=replace(m.header, stamp=replace(stamp, sec=ns // 10**9, nanosec=ns % 10**9)))

    return change


def play(path, **options):
    """Scans, calibration and problems of a bag."""
    with open_recording(path, **options) as recording:
        scans = [message for topic, message in recording.messages() if topic == "lidar/scan"]
        return scans, recording.rig, recording.problems


def points(message):
    """Valid points float64 [N, 2] of a scan in the lidar frame, sorted."""
    a = message.angle_min_rad + message.angle_increment_rad * np.arange(len(message.ranges_m))
    r = message.ranges_m.astype(np.float64)
    keep = (r > message.range_min_m) & (r < message.range_max_m)
    found = np.round(np.stack([r * np.cos(a), r * np.sin(a)], axis=1)[keep], 4)
    return found[np.lexsort(found.T)]


def is_right(scans, lasers):
    """Whether the scans are those of the ideal driver: points within 1 cm, times within 20 ms."""
    if abs(len(scans) - len(lasers)) > 3:
        return False
    by_stamp = sorted(scans, key=lambda m: m.stamp_ns)
    for laser in lasers[10:-10:15]:
        one = min(by_stamp, key=lambda m: abs(m.stamp_ns - laser.stamp_ns))
        angles = laser.angle_min_rad + laser.angle_increment_rad * np.arange(len(laser.ranges_m))
        r = laser.ranges_m.astype(np.float64)
        keep = np.isfinite(r)
        truth = np.stack([r * np.cos(angles), r * np.sin(angles)], axis=1)[keep]
        mine = points(one)
        if abs(one.stamp_ns - laser.stamp_ns) > 20_000_000 or len(mine) < 0.9 * len(truth):
            return False
        if abs(one.time_increment_s - laser.time_increment_s) > 0.1 * laser.time_increment_s:
            return False
        nearest = np.linalg.norm(truth[:, None] - mine[None], axis=2).min(axis=1)
        if np.quantile(nearest, 0.9) > 0.01:
            return False
    return True


# --- the cases -------------------------------------------------------------------------------------------


def test_c03_two_robots_with_the_same_names_of_frames(tmp_path, clean):
    bench = Bench(tmp_path / "b")
    wrong = [("base_link", "laser", (-0.3, 0.0, 0.18), (0.0, 0.0, 1.0, 0.0))]

    def change(row):
        rows = [("/robot1" + row[0], row[1], row[2])]
        return (
            [*rows, ("/robot2/tf_static", bench.transforms(wrong), row[2] + 10**7)]
            if "tf" in row[0]
            else rows
        )

    path = bench.write(clean[0][:40], clean[1], change)
    _, rig, problems = play(path, scan_topic="/robot1/scan", odometry_topic="/robot1/odom")
    assert rig.lidar.T_body_lidar[:3, 3] == pytest.approx([0.0, 0.0, 0.18])
    assert rig.lidar.T_body_lidar[0, 0] == pytest.approx(1.0)
    assert problems == []


def test_two_robots_on_one_topic_of_transforms_are_named(tmp_path, clean):
    bench = Bench(tmp_path / "b")
    wrong = [("base_link", "laser", (-0.3, 0.0, 0.18), (0.0, 0.0, 1.0, 0.0))]
    path = bench.write(
        *clean, lambda row: [row, (row[0], bench.transforms(wrong), row[2] + 1)] if "tf" in row[0] else [row]
    )
    _, _, problems = play(path)
    assert any("base_link -> laser was published with different values" in problem for problem in problems)
    # And the one that is used does not fit the motion.
    assert any("its yaw is 180 deg, but by the motion" in problem for problem in problems)


@pytest.mark.parametrize(
    ("quat", "tilt"), [((-0.5, 0.5, -0.5, 0.5), 90), ((0.0, math.sin(0.13), 0.0, math.cos(0.13)), 15)]
)
def test_c04_a_tilted_plane_is_refused_by_its_angle(tmp_path, clean, quat, tilt):
    path = Bench(tmp_path / "b", mount=quat).write(clean[0][:40], clean[1][:80])
    report = inspect(path, SourceOptions())
    with pytest.raises(UserError) as refused:
        play(path)
    assert report.error == str(refused.value)
    for words in (str(path), "/scan", "frame_id = 'laser'", f"tilted by {tilt} degrees", "rig file"):
        assert words in report.error


def test_c10_scans_that_were_all_refused_are_used(tmp_path, clean):
    changes = {
        "time_increment": scan(time_increment=153333.328125, scan_time=110400000.0),
        "range_max": scan(range_max=math.inf, range_min=0.0),
        "clockwise": scan(time_increment=lambda m: -m.time_increment),
        "intensities": scan(intensities=np.zeros(BEAMS + 1, np.float32)),
        "degrees": scan(angle_min=-180.0, angle_max=176.0, angle_increment=4.0),
    }
    fields = {"clockwise": "time_increment", "degrees": "angle_increment"}
    for name, change in changes.items():
        path = Bench(tmp_path / name).write(clean[0][:50], clean[1][:100], change)
        scans, _, problems = play(path)
        assert is_right(scans, clean[0][:50]), name
        assert any(f"/scan: 50 messages repaired: {fields.get(name, name)} = " in text for text in problems)
        assert inspect(path, SourceOptions()).error == ""


def test_c14_a_zero_quaternion_is_named_and_hides_nothing(tmp_path, clean):
    edges = [
        ("base_link", "imu_link", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 0.0)),
        ("base_link", "laser", (0.1, 0.0, 0.18), (0.0, 0.0, 0.0, 2.0)),
    ]
    path = Bench(tmp_path / "b").write(clean[0][:40], clean[1][:80], edges=edges)
    _, rig, problems = play(path)
    assert rig.lidar.T_body_lidar[0, 3] == pytest.approx(0.1)
    text = " ".join(problems)
    assert "/tf_static: 1 message refused: transform base_link -> imu_link: rotation = [0 0 0 0]" in text
    assert "transform base_link -> laser: rotation = [0 0 0 2]: its length is 2" in text


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda ns: START_NS, "all scans have the same stamp: the receive times are used"),
        (lambda ns: ns // 10**9 * 10**9, "different stamps: the receive times are used"),
        (lambda ns: ns // 1000, "the receive times are used"),
        (lambda ns: 0, "the scan has no stamp: the receive time is used"),
        (lambda ns: ns + 98_888_889, "it is taken as the time of the last beam"),
        (lambda ns: ns - START_NS + 600 * 10**9, "count from the start of the device"),
        (lambda ns: ns + 3600 * 10**9, "are on another clock than the receive times"),
    ],
)
def test_c17_stamps_that_do_not_tell_are_replaced(tmp_path, clean, function, words):
    path = Bench(tmp_path / "b").write(clean[0][:60], clean[1][:120], on("/scan", stamped(function)))
    scans, _, problems = play(path)
    assert is_right(scans, clean[0][:60])
    assert any(words in problem and "header.stamp = " in problem for problem in problems)


@pytest.mark.parametrize("unit", ["us", "ms", "s"])
def test_c17_a_folder_with_stamps_in_another_unit(tmp_path, clean, unit):
    factor = {"us": 1000, "ms": 10**6, "s": 10**9}[unit]
    lasers = clean[0][:120:10] if unit == "s" else clean[0][:60]
    lines = [
        f"# {name} = {value}"
        for name, value in (
            ("angle_min_rad", lasers[0].angle_min_rad), ("angle_increment_rad", lasers[0].angle_increment_rad),
            ("range_min_m", 0.1), ("range_max_m", 12.0), ("time_increment_s", lasers[0].time_increment_s),
        )
    ]  # fmt: skip
    lines += [f"{m.stamp_ns // factor}, " + ", ".join(map(str, m.ranges_m)) for m in lasers]
    (tmp_path / "scans.csv").write_text("\n".join(lines))
    (tmp_path / "rig.toml").write_text("[lidar.mount]\nxyz_m = [0.0, 0.0, 0.18]\nrpy_deg = [0.0, 0.0, 0.0]\n")
    scans, _, problems = play(tmp_path)
    assert [m.stamp_ns for m in scans] == [m.stamp_ns // factor * factor for m in lasers]
    assert any(
        f"stamp = {lasers[0].stamp_ns // factor}" in text and "were converted" in text for text in problems
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"angle_increment": lambda m: -m.angle_increment}, "the turns then agree with those of the odometry"),
        pytest.param({"angle_increment": lambda m: m.angle_increment * 1.03}, "angle_increment = ", marks=pytest.mark.slow),
        pytest.param({"angle_increment": lambda m: m.angle_increment * 0.97}, "angle_increment = ", marks=pytest.mark.slow),
        pytest.param({"angle_increment": 0.0}, "angle_increment = 0", marks=pytest.mark.slow),
        pytest.param({"angle_max": 1.0}, "angle_max 1", marks=pytest.mark.slow),
        pytest.param({"angle_max": math.nan}, "angle_max nan", marks=pytest.mark.slow),
        ({"angle_min": 0.0}, "angle_min 0"),
        pytest.param({"angle_min": math.nan}, "angle_min nan", marks=pytest.mark.slow),
        (
            {"angle_min": lambda m: -m.angle_min, "angle_max": lambda m: -m.angle_max,
             "angle_increment": lambda m: -m.angle_increment},
            "the scans are mirrored",
        ),
    ],
)  # fmt: skip
def test_c18_contradicting_or_mirrored_directions_are_resolved(tmp_path, clean, changes, words):
    path = Bench(tmp_path / "b").write(*clean, scan(**changes))
    scans, _, problems = play(path)
    assert any(
        f"/scan: {len(clean[0])} messages repaired: angle_" in text and words in text for text in problems
    )
    assert is_right(scans, clean[0])


# --- more of the same kinds --------------------------------------------------------------------------------


def test_a_mount_that_moves_is_refused(tmp_path, clean):
    bench = Bench(tmp_path / "b")

    def change(row):
        if row[0] != "/odom":
            return [] if "tf" in row[0] else [row]
        yaw = 0.3 * math.sin(row[2] * 1e-9)
        edges = [("base_link", "laser", (0.0, 0.0, 0.18), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))]
        return [row, ("/tf", bench.transforms(edges), row[2])]

    path = bench.write(clean[0][:40], clean[1][:80], change)
    with pytest.raises(UserError, match="moving mount: the transform base_link -> laser changes"):
        play(path)
    assert "moving mount" in inspect(path, SourceOptions()).error


def test_a_mount_on_tf_that_does_not_move_is_used(tmp_path, clean):
    path = Bench(tmp_path / "b").write(
        clean[0][:40], clean[1][:80], lambda row: [("/tf", row[1], row[2])] if "tf" in row[0] else [row]
    )
    assert play(path)[1].lidar.T_body_lidar[2, 3] == pytest.approx(0.18)


def test_scans_of_a_second_lidar_on_the_topic_are_left_out(tmp_path, clean):
    def change(row):
        rear = replace(row[1], header=replace(row[1].header, frame_id="rear")) if row[0] == "/scan" else None
        return (
            [row]
            if rear is None
            else [row, (row[0], replace(rear, ranges=rear.ranges[::-1].copy()), row[2] + 1)]
        )

    scans, _, problems = play(Bench(tmp_path / "b").write(clean[0][:40], clean[1][:80], change))
    assert is_right(scans, clean[0][:40])
    assert "/scan: 40 messages refused: header.frame_id = rear" in problems[0]


def in_parts(number, *, as_sectors):
    """Each revolution in `number` messages: of their own beams, or on the whole grid with zeros elsewhere."""

    def change(row):
        if row[0] != "/scan":
            return [row]
        m, n, rows = row[1], len(row[1].ranges), []
        for k in range(number):
            a, b = k * n // number, (k + 1) * n // number
            part = stamped(lambda ns, a=a: ns + round(a * m.time_increment * 1e9))(m)
            if as_sectors:
                ranges = np.zeros_like(m.ranges)
                ranges[a:b] = m.ranges[a:b]
                part = replace(part, ranges=ranges)
            else:
                first = m.angle_min + a * m.angle_increment
                last = first + (b - a - 1) * m.angle_increment
                part = replace(part, ranges=m.ranges[a:b], angle_min=first, angle_max=last)
            rows.append((row[0], part, row[2] - round((n - b) * m.time_increment * 1e9)))
        return rows

    return change


@pytest.mark.parametrize("as_sectors", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_parts_of_revolutions_are_assembled(tmp_path, clean, as_sectors):
    path = Bench(tmp_path / "b").write(*clean, in_parts(4, as_sectors=as_sectors))
    scans, _, problems = play(path)
    assert {len(m.ranges_m) for m in scans} == {BEAMS}
    assert is_right(scans, clean[0])
    assert any("each message is a part of a revolution" in problem for problem in problems)


def test_messages_of_316_degrees_give_whole_revolutions(tmp_path, drive, clean):
    """As of an ORADAR MS200: 79 of 90 beams in each message, the next one starts where it ended."""
    all_ranges = np.concatenate([m.ranges_m for m in clean[0]])
    first, lasers = clean[0][0], oradar_ms200(clean[0])
    assert {len(m.ranges_m) for m in lasers} == {79}
    scans, _, problems = play(Bench(tmp_path / "b").write(lasers, clean[1]))
    assert len(scans) >= len(clean[0]) - 2
    assert {len(m.ranges_m) for m in scans} == {BEAMS}
    # Every beam is at its place in the sequence of the ideal driver.
    for message in scans[5:-5:10]:
        number = round((message.stamp_ns - START_NS) / (first.time_increment_s * 1e9))
        assert np.array_equal(message.ranges_m, all_ranges[number : number + BEAMS], equal_nan=True)
        angle = first.angle_min_rad + number * first.angle_increment_rad
        assert math.remainder(message.angle_min_rad - angle, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
    assert any("assembled" in problem for problem in problems)


def test_what_was_found_about_the_beams_is_stored_in_the_rig_and_used_from_it(tmp_path, drive, clean):
    lasers = [sllidar_ros2(m, k) for k, m in enumerate(sweeps(drive, beams=BEAMS, clockwise=True))]
    path = Bench(tmp_path / "b").write(lasers, clean[1])
    text, notes = draft_from_data(path)
    assert "reversed within" in " ".join(notes)
    rig = tmp_path / "rig.toml"
    rig.write_text(text)
    found = load_rig(rig).lidar.scan
    assert (found.order, found.sweep_s) == ("reversed", pytest.approx(0.0989, abs=1e-3))
    # A part of the drive without a turn, which shows nothing by itself.
    straight = Bench(tmp_path / "c").write(lasers[:25], clean[1][:50])
    assert {np.sign(m.angle_increment_rad) for m in play(straight)[0]} == {1.0}
    scans, _, problems = play(straight, rig=rig)
    assert {np.sign(m.angle_increment_rad) for m in scans} == {-1.0}
    assert "set in the rig file" in problems[0]


# --- property: each field, changed ---------------------------------------------------------------------------

QUATERNIONS = {
    "yaw 180": (0.0, 0.0, 1.0, 0.0), "yaw 90": (0.0, 0.0, 0.7071, 0.7071), "yaw 20": (0.0, 0.0, 0.1736, 0.9848),
    "optical": (-0.5, 0.5, -0.5, 0.5), "upside down": (1.0, 0.0, 0.0, 0.0), "zero": (0.0, 0.0, 0.0, 0.0),
    "nan": (0.0, 0.0, math.nan, 1.0), "long": (0.0, 0.0, 0.0, 3.0),
}  # fmt: skip
_NUMBERS = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-9, 1e9)
MUTATIONS = {
    **{
        f"{field} = {value}": scan(**{field: value})
        for field in (
            "angle_min", "angle_max", "angle_increment", "time_increment", "scan_time", "range_min",
            "range_max",
        )
        for value in _NUMBERS
    },
    **{
        f"{field} * {factor}": scan(**{field: lambda m, field=field, factor=factor: factor * getattr(m, field)})
        for field in ("angle_min", "angle_max", "angle_increment", "time_increment", "range_max", "ranges")
        for factor in (-1.0, 0.5, 2.0, math.degrees(1.0), 100.0, 1000.0, 1e9)
        if (field, factor) not in (("ranges", -1.0), ("range_max", 0.5))
    },
    "ranges reversed": scan(ranges=lambda m: m.ranges[::-1].copy()),
    "ranges cut": scan(ranges=lambda m: m.ranges[: BEAMS // 2].copy()),
    "ranges empty": scan(ranges=lambda m: m.ranges[:0].copy()),
    "ranges nan": scan(ranges=lambda m: m.ranges * np.float32(np.nan)),
    "intensities": scan(intensities=np.ones(7, np.float32)),
}  # fmt: skip


@pytest.mark.slow
def test_no_changed_field_gives_wrong_scans_without_a_sentence(tmp_path, clean):
    for number, (name, change) in enumerate(MUTATIONS.items()):
        path = Bench(tmp_path / str(number)).write(*clean, change)
        problems, right = [], False
        try:
            scans, _, problems = play(path)
            right = is_right(scans, clean[0])
        except UserError as error:
            problems = [str(error)]
        assert right or any("/scan" in text for text in problems), name
        if number % 6 == 0:  # what replay refuses, `info` names
            report = inspect(path, SourceOptions())
            assert set(problems) <= {*report.problems, report.error}, name


@pytest.mark.slow
def test_no_changed_mount_gives_a_wrong_map_without_a_sentence(tmp_path, clean):
    for name, quat in QUATERNIONS.items():
        path = Bench(tmp_path / name.replace(" ", "_"), mount=quat).write(*clean)
        try:
            problems = play(path)[2]
        except UserError as error:
            problems = [str(error)]
        assert problems, name
