"""The office floor: ranges against exact geometry, glass, people, routes, lost stretches, equal bytes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from beamsplat.common.geometry.trajectory import read_tum
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.source import open_source
from beamsplat.tools.cli.main import app
from beamsplat.tools.simulator.office.caster import SegmentGrid, build_grid, cast_revolution
from beamsplat.tools.simulator.office.floor import FloorPlan, build_floor
from beamsplat.tools.simulator.office.people import LEG_RADIUS_M, PERSONAL_M, People
from beamsplat.tools.simulator.office.recording import measure, simulate_office
from beamsplat.tools.simulator.office.route import plan_route
from beamsplat.tools.simulator.office.settings import OfficeSettings
from beamsplat.tools.simulator.settings import LidarSettings, WheelSettings
from beamsplat.tools.simulator.wheels import TRACK_M, WheelOdometrySimulator
from tests.services.localization.world import cast

# Low rates keep the recordings of these tests small.
SMALL = OfficeSettings(
    seed=5, length_m=40.0, width_m=30.0, distance_m=20.0, people=3,
    lidar=LidarSettings(beams=180, rate_hz=2.0, range_max_m=25.0, glass=True), wheels=WheelSettings(rate_hz=4.0),
)  # fmt: skip
ROOM = np.array([[0, 0, 10, 0], [10, 0, 10, 6], [10, 6, 0, 6], [0, 6, 0, 0]], dtype=float)


def grid_of(segments: np.ndarray, glass: np.ndarray | None = None) -> SegmentGrid:
    none = np.zeros(0)
    return build_grid(
        FloorPlan(segments, np.zeros(len(segments), bool) if glass is None else glass, none, none, none, none)
    )


def revolution(grid, pose, *, to=None, circles=None, beams=360, range_max=30.0):
    """Cast a revolution that starts at `pose` and ends at `to`; angles start at 0 in the body frame."""
    knots = np.linspace(pose, pose if to is None else to, 11)
    out, moving = np.zeros((beams, 4)), np.zeros(beams, bool)
    legs = np.zeros((10, 0, 3)) if circles is None else np.tile(circles, (10, 1, 1))
    cast_revolution(
        knots, 0.0, 0.0, 0.0, 2.0 * np.pi / beams, range_max, grid.segments, grid.glass, grid.low_m,
        *grid.shape, grid.start, grid.index, legs, out, moving,
    )  # fmt: skip
    return out, moving


def test_ranges_to_walls_are_exact():
    x, y, yaw = 3.7, 2.2, 0.3
    out, moving = revolution(grid_of(ROOM), np.array([x, y, yaw]))
    angle = yaw + np.arange(360) * np.radians(1.0)
    c, s = np.cos(angle), np.sin(angle)
    to_x = np.where(c > 0, (10 - x) / c, -x / c)
    to_y = np.where(s > 0, (6 - y) / s, -y / s)
    assert out[:, 0] == pytest.approx(np.minimum(to_x, to_y), abs=1e-9)
    assert out[:, 1] == pytest.approx(np.where(to_x < to_y, np.abs(c), np.abs(s)), abs=1e-9)
    assert np.isinf(out[:, 2]).all()
    assert not moving.any()


def test_a_near_object_hides_the_wall_and_a_gap_shows_what_is_behind():
    door = np.array([[6, 0, 6, 2.5], [6, 3.5, 6, 6]], dtype=float)  # a wall with a door of 1 m at y = 3
    out, _ = revolution(grid_of(np.vstack([ROOM, door])), np.array([2.0, 3.0, 0.0]))
    assert out[0, 0] == pytest.approx(8.0)  # through the door
    assert out[7, 0] == pytest.approx(8.0 / np.cos(np.radians(7.0)))  # its edge is at 7.13 degrees
    assert out[8, 0] == pytest.approx(4.0 / np.cos(np.radians(8.0)))
    assert out[180, 0] == pytest.approx(2.0)


def test_the_grid_gives_the_same_ranges_as_all_segments():
    plan = build_floor(SMALL)
    rng = np.random.default_rng(0)
    grid = build_grid(plan)
    for pose in plan_route(plan, SMALL).pose_at(rng.uniform(0.0, 60.0, 3)):
        out, _ = revolution(grid, pose, beams=180, range_max=100.0)
        solid = plan.segments[~plan.glass]
        angles = pose[2] + np.arange(180) * np.radians(2.0)
        exact = cast(np.tile(pose[:2], (180, 1)), angles, solid)
        assert out[:, 0] == pytest.approx(exact, abs=1e-9)


def test_each_beam_starts_where_the_robot_is_at_its_time():
    start, end = np.array([3.0, 3.0, 0.0]), np.array([3.1, 3.02, 0.1])  # 1 m/s and 1 rad/s in 0.1 s
    out, _ = revolution(grid_of(ROOM), start, to=end)
    part = np.arange(360)[:, None] / 360.0
    poses = start + part * (end - start)
    exact = cast(poses[:, :2], poses[:, 2] + np.arange(360) * np.radians(1.0), ROOM)
    assert out[:, 0] == pytest.approx(exact, abs=1e-9)


def test_glass_is_seen_near_its_normal_passes_oblique_beams_and_mirrors_grazing_ones():
    lidar = LidarSettings(beams=4000, noise_m=0.0, dropout=0.0, range_max_m=25.0, glass=True)
    rng = np.random.default_rng(0)
    hits = np.tile([8.0, 1.0, 3.0, 1.0], (4000, 1))  # the wall at 8 m, the pane at 3 m

    def shares(degrees):
        hits[:, 3] = np.cos(np.radians(degrees))
        ranges, through = measure(hits, lidar, rng)
        assert (through == ((ranges == 8.0) & np.isfinite(hits[:, 2]))).all()
        return (ranges == 3.0).mean(), (ranges == 8.0).mean(), np.isinf(ranges).mean()

    assert shares(5.0) == pytest.approx((0.9, 0.1, 0.0), abs=0.03)
    assert shares(45.0) == pytest.approx((0.08, 0.92, 0.0), abs=0.03)
    assert shares(85.0) == pytest.approx((0.0, 0.2, 0.8), abs=0.03)
    hits[:, 2] = np.inf
    assert shares(5.0)[1] == 1.0  # no pane


def test_a_pane_is_reported_only_before_what_is_opaque():
    pane = np.array([[5, 0, 5, 6]], dtype=float)
    grid = grid_of(np.vstack([ROOM, pane]), np.array([False] * 4 + [True]))
    out, _ = revolution(grid, np.array([2.0, 3.0, 0.0]))
    assert out[0] == pytest.approx([8.0, 1.0, 3.0, 1.0])
    assert np.isinf(out[180, 2])


def test_legs_are_seen_as_circles_and_people_make_way():
    legs = np.array([[5.0, 3.0, 0.1]])
    out, moving = revolution(grid_of(ROOM), np.array([2.0, 3.0, 0.0]), circles=legs)
    assert out[0, 0] == pytest.approx(2.9)
    assert np.flatnonzero(moving).tolist() == [0, 1, 359]  # 0.1 m at 3 m is 1.9 degrees to each side
    plan = build_floor(SMALL)
    people = People(plan, 40, np.random.default_rng(1))
    seen = []
    for time_s in np.arange(0.0, 120.0, 0.5):
        robot = np.tile([plan.corridor_x_m[0], 15.0], (2, 1))
        circles = people.circles(np.array([time_s, time_s + 0.01]), robot, 100.0)
        centres = 0.5 * (circles[:, :40, :2] + circles[:, 40:, :2])
        assert np.linalg.norm(centres - robot[:, None], axis=-1).min() >= PERSONAL_M - 1e-9
        seen.append(centres[0])
        speed = np.linalg.norm(centres[1] - centres[0], axis=-1) / 0.01
        far = np.linalg.norm(centres[0] - robot[0], axis=-1) > 1.0
        assert speed[far].max() <= 1.5 + 1e-6
        assert (circles[..., 2] == LEG_RADIUS_M).all()
    assert np.ptp(np.array(seen), axis=0).max(axis=1).min() > 5.0  # all of them walk


def test_a_wheel_slips_now_and_then():
    perfect = WheelSettings(scale_error=(0.0, 0.0), turn_error=(0.0, 0.0), noise=0.0)
    truth = np.column_stack([np.arange(0.0, 3000.0, 0.05), np.zeros((60_000, 2))])  # straight, 3 km
    wheels = WheelOdometrySimulator(perfect, np.random.default_rng(0), slips_per_km=10.0)
    readings = [wheels.measure(part, 0.05) for part in np.array_split(truth, 30_000)]
    turn = np.concatenate([r.turn_rad_s for r in readings]) * 0.05
    speed = np.concatenate([r.speed_m_s for r in readings])
    slipping = turn != 0.0
    slips = np.split(turn, np.flatnonzero(np.diff(slipping.astype(int))) + 1)
    degrees = np.abs(np.degrees([part.sum() for part in slips if part[0] != 0.0]))
    assert len(degrees) == pytest.approx(30, abs=15)
    assert degrees.min() > 0.7
    assert degrees.max() < 13.0  # with one step more than SLIP_M
    assert (turn[slipping] > 0.0).any()
    assert (turn[slipping] < 0.0).any()
    assert speed[slipping] == pytest.approx(1.0 + np.abs(turn[slipping]) / 0.05 * TRACK_M / 2.0, abs=1e-9)
    assert (np.abs(speed[1:][~slipping[1:]] - 1.0) < 1e-9).all()


@pytest.mark.parametrize("aliased", [False, True])
def test_the_robot_keeps_clear_of_everything(aliased):
    settings = replace(SMALL, length_m=45.0, distance_m=250.0, aliased=aliased)
    plan = build_floor(settings)
    drive = plan_route(plan, settings)
    assert 250.0 < drive.length_m < 450.0
    pose = drive.pose_at(np.arange(0.0, drive.lap_s, 1.0))
    a, e = plan.segments[:, :2], plan.segments[:, 2:] - plan.segments[:, :2]
    for xy in pose[:, :2]:
        along = np.clip(((xy - a) * e).sum(axis=1) / (e * e).sum(axis=1), 0.0, 1.0)
        assert np.hypot(*(xy - a - along[:, None] * e).T).min() > 0.25


def test_an_aliased_floor_has_two_corridors_that_look_the_same_over_30_m():
    plan = build_floor(OfficeSettings(aliased=True, length_m=120.0, width_m=80.0))
    y, grid = plan.corridor_y_m, build_grid(plan)
    for x in np.linspace(plan.corridor_x_m[1], plan.corridor_x_m[2], 7):
        a, _ = revolution(grid, np.array([x, y[2], 0.1]), range_max=25.0)
        b, _ = revolution(grid, np.array([x, y[3], 0.1]), range_max=25.0)
        assert np.minimum(a[:, 0], 25.0) == pytest.approx(np.minimum(b[:, 0], 25.0), abs=1e-6)
    assert np.ptp(plan.corridor_x_m[1:3]) > 30.0
    varied = build_floor(OfficeSettings(length_m=120.0, width_m=80.0))
    x, y, grid = varied.corridor_x_m[1] + 10.0, varied.corridor_y_m, build_grid(varied)
    a, _ = revolution(grid, np.array([x, y[2], 0.1]))
    b, _ = revolution(grid, np.array([x, y[3], 0.1]))
    off = np.minimum(a[:, 0], 25.0) - np.minimum(b[:, 0], 25.0)
    assert (np.abs(off) > 0.1).mean() > 0.3


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    for name, settings in (("a", SMALL), ("b", SMALL), ("c", replace(SMALL, seed=6))):
        simulate_office(settings, tmp_path / name, replace=False, progress=lambda *_: None)
    names = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(names) == 6
    bytes_of = {k: [(tmp_path / k / n).read_bytes() for n in names] for k in "abc"}
    assert bytes_of["a"] == bytes_of["b"]
    assert bytes_of["a"] != bytes_of["c"]


def test_measurements_are_missing_in_lost_stretches_and_the_odometry_goes_on(tmp_path):
    settings = replace(SMALL, length_m=60.0, width_m=40.0, distance_m=200.0, lost=2, lost_s=10.0, people=0)
    simulate_office(settings, tmp_path / "r", replace=False, progress=lambda *_: None)
    lost = json.loads((tmp_path / "r" / "site.json").read_text())["lost"]
    assert [s["kind"] for s in lost] == ["silent", "blind"]
    source = open_source(tmp_path / "r" / "bag", SourceOptions())
    scans, odometry = {}, {}
    for _, topic, m in source.messages():
        (scans if topic == "lidar/scan" else odometry)[m.stamp_ns] = m
    source.close()

    def within(stamps, stretch):
        return [s for s in stamps if stretch["start_ns"] + 6e8 < s < stretch["end_ns"] - 6e8]

    assert not within(scans, lost[0])
    assert not within(odometry, lost[0])
    blind = within(scans, lost[1])
    assert len(blind) == pytest.approx(19, abs=2)
    assert not any(np.isfinite(scans[s].ranges_m).any() for s in blind)
    assert len(within(odometry, lost[1])) == pytest.approx(35, abs=2)
    # The wheels count on: the jump over the gap is the true motion within 4 %.
    truth = read_tum(tmp_path / "r" / "groundtruth.txt")
    before, after = (
        max(s for s in odometry if s < lost[0]["start_ns"]), min(s for s in odometry if s > lost[0]["end_ns"])
    )  # fmt: skip
    assert after - before > 9e9
    jump = np.linalg.norm((odometry[after].T_odom_body - odometry[before].T_odom_body)[:2, 3])
    at = np.searchsorted(truth.stamps_ns, [before, after])
    assert jump == pytest.approx(np.linalg.norm(np.diff(truth.T_a_b[at, :3, 3], axis=0)), rel=0.04)
    assert jump > 3.0
    # In its second half the robot is where it was not before.
    for s in lost:
        middle, end = 0.5 * (s["start_ns"] + s["end_ns"]), s["end_ns"]
        path = truth.T_a_b[:, :2, 3]
        old = path[truth.stamps_ns < middle - 20e9]
        new = path[(truth.stamps_ns >= middle) & (truth.stamps_ns <= end)][::4]
        assert np.linalg.norm(new[:, None] - old[None], axis=-1).min() > 3.0


def test_the_command_checks_its_options(tmp_path):
    run = CliRunner().invoke
    for options, why in (
        (["--site", "office"], "--lidar-only"),
        (["--site", "shed"], "'home' or 'office'"),
        (["--site", "office", "--lidar-only", "--size", "40"], "WIDTHxHEIGHT"),
        (["--movers", "7"], "at most 6"),
    ):
        result = run(app, ["simulate", "--out", str(tmp_path / "r"), *options], env={"COLUMNS": "200"})
        assert result.exit_code == 2
        assert why in result.output
    short = ["--site", "office", "--lidar-only", "--size", "40x30", "--distance-m", "20"]
    refused = run(app, ["simulate", "--out", str(tmp_path / "r"), *short, "--lost", "9"])
    assert refused.exit_code == 2
    assert not (tmp_path / "r").exists()
    done = run(app, ["simulate", "--out", str(tmp_path / "r"), *short, "--json"])
    summary = json.loads(done.stdout)
    assert summary["scans"] == int(summary["seconds"] * 10) - 1
    assert summary["metres"] > 80.0
