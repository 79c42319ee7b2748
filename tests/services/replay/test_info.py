"""`beamsplat info` and `beamsplat rig` on real bags, recordings and folders."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.rig import load_rig
from beamsplat.common.recording import RecordingWriter
from beamsplat.common.recording.mcap_file import McapFile
from beamsplat.common.recording.static_frames import StaticFrames
from beamsplat.services.replay.config import ReplayConfig
from beamsplat.services.replay.inspection import inspect
from beamsplat.services.replay.node import ReplayNode
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.statistics import lidar_statistics, topic_statistics
from beamsplat.tools.cli import info as cli
from tests.services.replay.make_bags import KINDS, T_BASE_CAMERA, T_BASE_LIDAR, Drive, write_bag


def run(*arguments):
    """Output and the sentence of the UserError that the command ended with, if any."""
    app = Typer()
    app.command()(cli.info)
    app.command()(cli.rig)
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, UserError):
        raise result.exception
    return result.stdout, str(result.exception or "")


@pytest.mark.parametrize("kind", KINDS)
def test_info_tells_rates_lags_sensors_and_calibration(tmp_path, kind):
    output, error = run("info", write_bag(tmp_path, kind, Drive(seconds=3.0)), "--json")
    report = json.loads(output)
    assert error == report["error"] == ""
    topics = {topic["name"]: topic for topic in report["topics"]}
    assert topics["/scan"]["count"] == 30
    assert topics["/scan"]["rate_hz"] == pytest.approx(10.0)
    assert topics["/scan"]["lag_median_ms"] == pytest.approx(30.0)
    assert topics["/odom"]["lag_median_ms"] == pytest.approx(0.0)
    assert report["sensors"] == {
        "image": "/camera/image_raw/compressed",
        "scan": "/scan",
        "odometry": "/odom",
    }
    assert report["lidar"]["beams_max"] == 36
    assert report["lidar"]["field_of_view_deg"] == pytest.approx(np.degrees(0.17 * 35), abs=0.01)
    assert report["lidar"]["no_return_share"] == pytest.approx(1 / 36)
    assert report["lidar"]["invalid_share"] == pytest.approx(1 / 36)
    assert (report["camera"]["fx_px"], report["camera"]["width_px"]) == (50.0, 64)
    assert any("base_link -> camera_optical_frame" in text for text in report["calibration_found"])
    assert report["duration_s"] == pytest.approx(2.93)


@pytest.mark.parametrize("kind", KINDS)
def test_info_still_shows_a_bag_that_cannot_be_played(tmp_path, kind):
    output, error = run("info", write_bag(tmp_path, kind, Drive(info_px=None)))
    assert "/camera/image_raw/compressed" in output
    assert "calibration is missing" in error
    (tmp_path / "second").mkdir()
    output, error = run("info", write_bag(tmp_path / "second", kind, Drive(scan=False)))
    assert "/odom" in output
    assert "has no scan" in error
    assert "\n" not in error


def test_a_table_for_people(tmp_path):
    output, _ = run("info", write_bag(tmp_path, "mcap", Drive()))
    for words in ("ROS 2 bag (MCAP)", "LaserScan", "36 beams over", "fx 50.0", "calibration found"):
        assert words in output


def test_info_of_our_own_recordings(tmp_path):
    node = ReplayNode(ReplayConfig(data=write_bag(tmp_path, "mcap", Drive())))
    with RecordingWriter(tmp_path / "rec") as writer:
        for at_ns, topic, message in node.source():
            writer.write(topic, message, at_ns)
    node.close()
    report = inspect(tmp_path / "rec", SourceOptions())
    assert (report.kind, report.error, report.problems) == ("recording", "", [])
    assert report.sensors["scan"] == "/lidar/scan"
    assert report.camera["fx_px"] == 50.0
    # Cut off it still opens, and says so.
    file = tmp_path / "rec" / "rec_0.mcap"
    with McapFile(file) as mcap:
        second = mcap._blocks[1]
    file.write_bytes(file.read_bytes()[: second.offset + second.length // 2])
    report = inspect(tmp_path / "rec", SourceOptions())
    assert report.error == ""
    assert len(report.problems) == 1
    assert "truncated: readable" in report.problems[0]


def test_a_recording_replayed_is_the_recording(tmp_path):
    path = write_bag(tmp_path, "ros1", Drive(pose=True))
    first = list(ReplayNode(ReplayConfig(data=path)).source())
    with RecordingWriter(tmp_path / "rec") as writer:
        for at_ns, topic, message in first:
            writer.write(topic, message, at_ns)
    second = list(ReplayNode(ReplayConfig(data=tmp_path / "rec")).source())
    assert [(item.at_ns, item.topic) for item in first] == [(item.at_ns, item.topic) for item in second]
    for a, b in zip(first, second):
        for name in type(a.message).model_fields:
            if name != "camera" and name != "lidar":
                np.testing.assert_array_equal(getattr(a.message, name), getattr(b.message, name))
    assert np.array_equal(first[0].message.camera.T_body_camera, second[0].message.camera.T_body_camera)


@pytest.mark.parametrize("name", ["house_a", "redkitchen/bag", "freiburg/aces.bag"])
def test_info_on_the_shared_recordings(shared_dir, name):
    report = inspect(shared_dir / "data" / name, SourceOptions())
    assert report.error == ""
    assert report.calibration_assumed == []
    if name == "house_a":
        assert report.problems == []
        lags = {topic.name: topic.lag_median_ms for topic in report.topics}
        assert lags["/scan"] > lags["/camera/image_raw/compressed"] > lags["/odom"] > 0
    if name == "freiburg/aces.bag":
        assert report.lidar.beams_max == 180
        assert any("50.00 m" in problem for problem in report.problems)


def test_rig_writes_what_it_found_and_the_file_plays(tmp_path):
    path = write_bag(tmp_path, "mcap", Drive())
    out = tmp_path / "rig.toml"
    _, error = run("rig", path, "--out", out)
    assert error == ""
    rig = load_rig(out).message(0, "")
    assert np.allclose(rig.camera.T_body_camera, T_BASE_CAMERA, atol=1e-8)
    assert np.allclose(rig.lidar.T_body_lidar, T_BASE_LIDAR, atol=1e-8)
    assert "MEASURE" not in out.read_text().split("[camera]")[1]
    assert ReplayNode(ReplayConfig(data=path, rig=out)).expected_messages() == 60
    assert "exists already" in run("rig", path, "--out", out)[1]
    assert run("rig", path, "--out", out, "--overwrite")[1] == ""


@pytest.mark.parametrize(
    "drive",
    [
        Drive(info_px=None, tf=""),
        Drive(info_px=(32, 24)),
        Drive(fx_px=0.0),
        Drive(tf=""),
        Drive(images="", tf=""),
    ],
)
def test_rig_says_what_must_be_measured_and_its_file_makes_the_bag_playable(tmp_path, drive):
    path = write_bag(tmp_path, "mcap", drive)
    out = tmp_path / "rig.toml"
    assert run("rig", path, "--out", out)[1] == ""
    assert "MEASURE" in out.read_text()
    node = ReplayNode(ReplayConfig(data=path, rig=out))
    rig = next(node.source()).message
    node.close()
    assert len(rig.assumed) >= 1
    assert (rig.camera is not None) == bool(drive.images)


def test_rig_of_a_camera_states_the_field_of_view_it_was_told(tmp_path):
    video = tmp_path / "camera.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (320, 240))
    writer.write(np.zeros((240, 320, 3), np.uint8))
    writer.release()
    _, error = run("rig", f"file://{video}", "--fov-deg", 90, "--out", tmp_path / "r.toml")
    assert error == ""
    camera = load_rig(tmp_path / "r.toml").camera
    assert (camera.width_px, camera.height_px, camera.fx_px) == (320, 240, 160.0)
    assert "90 degrees as stated" in (tmp_path / "r.toml").read_text()


def test_rig_of_what_is_no_robot(tmp_path):
    path = write_bag(tmp_path, "mcap", Drive(scan=False, images=""))
    assert "neither camera nor lidar" in run("rig", path, "--out", tmp_path / "r.toml")[1]
    assert "no image from this camera" in run("rig", "/dev/video99", "--out", tmp_path / "r.toml")[1]
    assert not (tmp_path / "r.toml").exists()


def test_gaps_and_backward_stamps_are_counted():
    at_ns = np.arange(100) * 10**8
    facts = topic_statistics("/t", "T", at_ns, at_ns - 5_000_000)
    assert (facts.gaps, facts.backwards, facts.lag_median_ms) == (0, 0, 5.0)
    gap = at_ns + np.where(np.arange(100) >= 50, 2 * 10**9, 0)
    facts = topic_statistics("/t", "T", gap, gap)
    assert facts.gaps == 1
    assert facts.largest_gap_s == pytest.approx(2.1)
    swapped = at_ns.copy()
    swapped[[10, 11]] = swapped[[11, 10]]
    assert topic_statistics("/t", "T", at_ns, swapped).backwards == 1
    assert topic_statistics("/t", "T", at_ns[:1], None).rate_hz is None


def test_a_mark_for_no_return_is_found_and_a_wall_is_not():
    fields = {
        "angle_min_rad": 0.0, "angle_increment_rad": 0.01, "time_increment_s": 0.0, "scan_time_s": 0.1,
        "range_min_m": 0.1, "range_max_m": 80.0,
    }  # fmt: skip
    rng = np.random.default_rng(0)
    real = rng.uniform(1, 60, 1000).astype(np.float32)
    assert lidar_statistics([{**fields, "ranges_m": real}]).most_common_far_m is None
    real[:50] = 81.83
    facts = lidar_statistics([{**fields, "ranges_m": real}])
    assert facts.most_common_far_m == pytest.approx(81.83)
    assert facts.most_common_far_share == pytest.approx(0.05)
    assert facts.beyond_share == pytest.approx(0.05)


def test_a_frame_that_moves_is_not_bolted_down():
    frames = StaticFrames()
    T = np.eye(4)
    frames.add("base_link", "/mast", T)
    T2 = np.eye(4)
    T2[0, 3] = 0.1
    frames.add("mast", "camera", T2)
    assert frames.find("base_link", "camera")[0, 3] == pytest.approx(0.1)
    assert frames.find("camera", "base_link")[0, 3] == pytest.approx(-0.1)
    frames.add("base_link", "mast", T2)
    assert frames.find("base_link", "camera") is None
    assert frames.moving == {("base_link", "mast")}
    frames.add("base_link", "mast", T)
    assert frames.find("base_link", "camera") is None
    assert frames.body_frame(["camera"], "odd_base") == "odd_base"


def test_a_looped_tree_does_not_hang():
    frames = StaticFrames()
    frames.add("a", "b", np.eye(4))
    frames.add("b", "a", np.eye(4))
    assert frames.find("a", "b") is not None
    assert frames.find("a", "z") is None
