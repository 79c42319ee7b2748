"""Presets of robots: what their drivers publish is read as their lidars measured, and mapped as if it were ideal."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from beamsplat.common.geometry.trajectory import read_tum
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.scans.laser import LaserMessage
from beamsplat.services.localization.lidar2d.offline_mapping import MeasurementLog, map_measurements
from beamsplat.services.replay.inspection import inspect
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.source import open_source
from beamsplat.tools.evaluation.slam import errors_against_truth, measurements
from beamsplat.tools.simulator import lidar_records, recording
from beamsplat.tools.simulator.lidar_drivers import (
    IDEAL,
    LDLIDAR_STL_ROS2,
    SLLIDAR_ROS2,
    YDLIDAR_ROS2_DRIVER,
    SectorFilter,
    publish,
)
from beamsplat.tools.simulator.robots import ROBOTS
from beamsplat.tools.simulator.settings import START_NS, SimulationSettings

# Words that a user is told about each robot's scans, and topics that are chosen.
REVERSED = "the beams are taken as measured in reversed order within 0."
LAST_BEAM = "it is taken as the time of the last beam"
TOLD = {
    "turtlebot4": [REVERSED],
    "rosmaster_x3": [REVERSED],
    "ugv_ld19": [REVERSED, LAST_BEAM],
    "jetrover_g4": [REVERSED],
}
CHOSEN = {
    "rosmaster_x3": ["/scan_filtered is used instead of /scan"],
    "jetrover_g4": ["/scan is used instead of /scan_raw", "/odom is used instead of /odom_raw"],
}
LAP_S = 50.0  # one lap in the scene of these tests takes 45 s


def simulate(out, scene, name, seconds, *, ideal=False, **changes):
    """Simulate a lidar-only drive of a robot, with its driver or an ideal one; return its settings."""
    base = SimulationSettings(seed=3, seconds=seconds, scene=str(scene), **{"lidar_only": True, **changes})
    settings = ROBOTS[name].applied(base)
    if ideal:  # what is removed on purpose is removed as well
        layout, removed = settings.layout, settings.layout.scan_filter
        if removed is not None:
            layout = replace(layout, scan_filter=replace(removed, beyond=False))
        settings = replace(settings, driver=replace(IDEAL, crop=settings.driver.crop), layout=layout)
    recording.simulate(settings, out, jobs=1, replace=False, progress=lambda *_: None)
    return settings


def read(folder, **options):
    """Return scans, problems and choices of a bag."""
    source = open_source(folder / "bag", SourceOptions(**options))
    scans = [m for _, topic, m in source.messages() if topic == "lidar/scan"]
    problems, choices = source.problems, source.choices
    source.close()
    return scans, problems, choices


def in_time(scan):
    """Return the valid ranges of a scan (read or published) and when (s after the start) and where (rad) they were measured."""
    index = np.arange(len(scan.ranges_m))
    angles = scan.angle_min_rad + scan.angle_increment_rad * index
    times = (scan.stamp_ns - START_NS) / 1e9 + scan.time_increment_s * index
    valid = (scan.ranges_m > scan.range_min_m) & (scan.ranges_m < scan.range_max_m)
    return scan.ranges_m[valid], times[valid], angles[valid]


def revolution(clockwise=True, beams=8):
    """Return an ideal message; beam i has the range 1 + i m, the third has no return."""
    step = (-2.0 if clockwise else 2.0) * np.pi / beams
    ranges = 1.0 + np.arange(beams, dtype=np.float32)
    ranges[2] = np.inf
    return LaserMessage(
        at_ns=START_NS + 105_000_000, stamp_ns=START_NS, frame_id="laser", angle_min_rad=np.pi,
        angle_max_rad=np.pi + (beams - 1) * step, angle_increment_rad=step, time_increment_s=0.1 / beams,
        scan_time_s=0.1, range_min_m=0.1, range_max_m=12.0, ranges_m=ranges, intensities=np.zeros(0, np.float32),
    )  # fmt: skip


def test_an_ideal_driver_changes_nothing_and_the_others_publish_what_their_sources_say():
    ideal = revolution()
    same = publish(IDEAL, ideal, 5)
    assert replace(same, ranges_m=ideal.ranges_m, intensities=ideal.intensities) == ideal
    np.testing.assert_array_equal(same.ranges_m, ideal.ranges_m)
    m = publish(replace(SLLIDAR_ROS2, copies=2), ideal, 0)
    assert (m.angle_min_rad, m.angle_max_rad) == pytest.approx((-np.pi, np.pi))
    assert m.angle_increment_rad == pytest.approx(2.0 * np.pi / 7)
    assert m.time_increment_s == pytest.approx(0.1 / 7)
    assert m.ranges_m.tolist() == [
        8.0,
        7.0,
        6.0,
        5.0,
        4.0,
        2.0,
        2.0,
        1.0,
    ]  # the third has a copy of the second
    assert m.stamp_ns == START_NS
    m = [publish(LDLIDAR_STL_ROS2, ideal, k) for k in range(4)]
    assert [len(one.ranges_m) for one in m] == [8, 7, 6, 8]
    assert m[0].stamp_ns == START_NS + 104_000_000
    assert np.isnan(m[0].ranges_m[5])
    # Two beams for one direction: the nearer one is kept, and another direction has none.
    assert np.flatnonzero(np.isnan(m[2].ranges_m)).size >= 1
    assert m[2].ranges_m[-1] == 1.0
    m = publish(YDLIDAR_ROS2_DRIVER, ideal, 0)
    assert m.ranges_m[5] == 0.0
    assert (m.range_min_m, m.range_max_m) == (0.1, 64.0)
    assert SectorFilter(0.0, 1.0, beyond=True).apply(m).ranges_m.tolist()[4:6] == [65.0, 0.0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_beams_are_read_with_the_time_and_the_direction_of_their_measurement(
    scene_file, own_cache, tmp_path, monkeypatch, name
):
    truth = []  # what an ideal driver would publish
    monkeypatch.setattr(lidar_records, "publish", lambda *args: truth.append(args[1]) or publish(*args))
    settings = simulate(tmp_path / "robot", scene_file, name, 30.0)
    scans, problems, choices = read(tmp_path / "robot")
    assert len(scans) == len(truth) > 200
    lidar, copies = settings.lidar, settings.driver.copies
    step_rad = abs(lidar.angle_increment_rad)
    for scan, ideal in zip(scans[10:-10:20], truth[10:-10:20]):
        ranges, times, angles = in_time(scan)
        exact, true_times, true_angles = in_time(ideal)
        by_range = {float(r): k for k, r in enumerate(exact)}
        pairs = [(i, by_range[float(r)]) for i, r in enumerate(ranges) if float(r) in by_range]
        assert len(pairs) > 0.99 * len(ranges)
        assert len(ranges) > 0.6 * len(exact)  # a part of the directions is removed on purpose
        mine, theirs = np.array(pairs).T
        off_rad = np.angle(np.exp(1j * (angles[mine] - true_angles[theirs])))
        assert np.abs(off_rad).max() < (copies + 0.1) * step_rad
        # The receive time stands in for stamps of the end, a few ms later.
        assert np.abs(times[mine] - true_times[theirs]).max() < 0.015 + copies * lidar.time_increment_s
    topic = settings.layout.scan_topic
    for words in TOLD[name]:
        assert any(f"{topic}: {len(scans)} messages repaired" in p and words in p for p in problems)
    for words in CHOSEN.get(name, []):
        assert any(words in choice for choice in choices)


def direction_error_rad(settings):
    """Return by how much the published directions are turned on average, over the beams that are left."""
    lidar = settings.lidar
    ideal = replace(
        revolution(lidar.clockwise, lidar.beams),
        ranges_m=(1.0 + 0.005 * np.arange(lidar.beams)).astype(np.float32),  # each beam has its own
        angle_min_rad=lidar.angle_min_rad,
        angle_max_rad=lidar.angle_min_rad + (lidar.beams - 1) * lidar.angle_increment_rad,
    )
    published = publish(settings.driver, ideal, 0)
    if settings.layout.scan_filter is not None:
        published = settings.layout.scan_filter.apply(published)
    exact, _, true_angles = in_time(ideal)
    ranges, _, angles = in_time(published)
    by_range = dict(zip(exact.tolist(), true_angles.tolist()))
    off = [np.angle(np.exp(1j * (a - by_range[r]))) for r, a in zip(ranges.tolist(), angles.tolist())]
    return float(abs(np.mean(off)))


def mapped(folder, **options):
    """Map a recording as `beamsplat slam` does; return the errors and the figures of the map."""
    without = frozenset({"image", "pose"})
    source = open_source(folder / "bag", SourceOptions(without=without, **options))
    log = MeasurementLog(source.rig().lidar.T_body_lidar, measurements(source), lambda: None)
    figures = map_measurements(log, folder / "map")
    source.close()
    return errors_against_truth(folder / "map", folder / "groundtruth.txt"), figures


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_a_lap_is_mapped_as_with_an_ideal_driver_but_for_the_directions(
    scene_file, own_cache, tmp_path, name
):
    """The drivers state directions that are up to a beam off, which turns the path about its start."""
    settings = simulate(tmp_path / "robot", scene_file, name, LAP_S)
    simulate(tmp_path / "ideal", scene_file, name, LAP_S, ideal=True)
    errors, figures = mapped(tmp_path / "robot")
    clean, _ = mapped(tmp_path / "ideal")
    path_m = read_tum(tmp_path / "robot/groundtruth.txt").T_a_b[:, :2, 3]
    reach_m = np.linalg.norm(path_m - path_m[0], axis=1).max()
    turned_m = direction_error_rad(settings) * reach_m
    assert errors["ate_first_pose_rmse_m"] <= 1.2 * clean["ate_first_pose_rmse_m"] + turned_m
    assert errors["ate_se3_rmse_m"] < 0.006
    assert errors["loops_wrong"] == 0
    assert figures["refused"] == {}
    found, truth = (
        read_tum(tmp_path / "robot/map/trajectory.tum"),
        read_tum(tmp_path / "robot/groundtruth.txt"),
    )
    at = np.searchsorted(truth.stamps_ns, found.stamps_ns[[0, -1]]).clip(max=len(truth.stamps_ns) - 1)
    moved = np.linalg.inv(found.T_a_b[0]) @ found.T_a_b[-1]
    true_move = np.linalg.inv(truth.T_a_b[at[0]]) @ truth.T_a_b[at[1]]
    assert np.linalg.norm(true_move[:2, 3]) < 2.5
    assert np.linalg.norm(moved[:2, 3] - true_move[:2, 3]) < 0.05  # it closes


@pytest.mark.slow
def test_a_cable_in_the_view_of_the_lidar_is_found(scene_file, own_cache, tmp_path):
    simulate(tmp_path / "x3", scene_file, "rosmaster_x3", LAP_S)
    _, figures = mapped(tmp_path / "x3", scan_topic="/scan")
    assert len(figures["self_returns"]) == 1
    assert figures["self_returns"][0]["range_m"] == pytest.approx(0.10, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_images_and_calibration_of_a_robot_are_those_of_its_camera(scene_file, own_cache, tmp_path, name):
    preset = ROBOTS[name]
    base = SimulationSettings(
        seed=3, seconds=4.0, scene=str(scene_file), extra_views=0, surface_points=100, truth_every=100
    )
    settings = preset.applied(base, rate_hz=1.0)
    recording.simulate(settings, tmp_path / "r", jobs=1, replace=False, progress=lambda *_: None)
    source = open_source(tmp_path / "r/bag", SourceOptions())
    camera = source.rig().camera
    images = [m for _, topic, m in source.messages() if topic == "camera/image"]
    source.close()
    K = settings.camera.K
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == pytest.approx(
        (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    )
    np.testing.assert_allclose(camera.T_body_camera, settings.camera.T_body_camera, atol=1e-9)
    assert len(images) == 4
    depth = cv2.imread(str(next((tmp_path / "r/depth_gt").iterdir())), cv2.IMREAD_UNCHANGED)
    for m in images:
        rgb = decode_rgb(m.data, m.encoding, m.width_px, m.height_px, m.step_bytes)
        assert rgb.shape == (settings.camera.height_px, settings.camera.width_px, 3)
        assert depth.shape == rgb.shape[:2]
        assert rgb.std() > 3.0
    report = inspect(tmp_path / "r/bag", SourceOptions())
    assert report.error == ""
    assert report.sensors["image"] == settings.layout.image_topic
