"""Plain folders: pictures, PCD or CSV scans, TUM poses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.common.errors import UserError
from beamsplat.services.replay.config import ReplayConfig
from beamsplat.services.replay.folder_scans import CsvScans, scan_from_points, xy_from_pcd
from beamsplat.services.replay.node import ReplayNode
from tests.services.replay.test_bags import RIG, of, picture, play, refusal

STAMP_NS = 1_700_000_000 * 10**9


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "drive"
    (path / "images").mkdir(parents=True)
    (path / "lasers").mkdir()
    for i in range(5):
        stamp = STAMP_NS + i * 10**8
        cv2.imwrite(str(path / "images" / f"{stamp}.png"), picture(i))
        angles = np.radians(np.arange(0, -360, -2.0))
        points = np.stack([3.0 * np.cos(angles), 3.0 * np.sin(angles)], axis=1)
        points[7] = 0.0
        write_pcd(path / "lasers" / f"{stamp + 5_000_000}.pcd", points)
    lines = [f"{1_700_000_000 + i / 10:.9f} {i / 10} 0 0 0 0 0 1" for i in range(5)]
    (path / "odometry.txt").write_text("\n".join(lines))
    (path / "poses.txt").write_text("\n".join(lines))
    (path / "rig.toml").write_text(RIG)
    return path


def write_pcd(file, points, binary=False):
    kind = "binary" if binary else "ascii"
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
    head += f"POINTS {len(points)}\nDATA {kind}\n"
    rows = np.column_stack([points, np.zeros(len(points))]).astype(np.float32)
    body = rows.tobytes() if binary else "\n".join(" ".join(map(str, row)) for row in rows).encode()
    file.write_bytes(head.encode() + body)


def points_of(scan):
    """Points float64 [N, 2] of the beams of a scan that returned something."""
    angles = scan.angle_min_rad + scan.angle_increment_rad * np.arange(len(scan.ranges_m))
    hit = np.isfinite(scan.ranges_m)
    return np.stack([scan.ranges_m * np.cos(angles), scan.ranges_m * np.sin(angles)], axis=1)[hit]


def test_a_folder_plays_by_stamp(folder):
    sourced, problems = play(folder)
    assert problems == []
    assert [item.at_ns for item in sourced] == sorted(item.at_ns for item in sourced)
    assert {t: len(of(sourced, t)) for t in ("camera/image", "lidar/scan", "wheel/odometry", "external/pose")} == {
        "camera/image": 5, "lidar/scan": 5, "wheel/odometry": 5, "external/pose": 5,
    }  # fmt: skip
    image = of(sourced, "camera/image")[2].message
    assert image.data.tobytes() == (folder / "images" / f"{image.stamp_ns}.png").read_bytes()
    assert of(sourced, "wheel/odometry")[3].message.velocity_m_s == pytest.approx([1.0, 0.0, 0.0])
    scan = of(sourced, "lidar/scan")[0].message
    assert scan.stamp_ns == STAMP_NS + 5_000_000
    assert len(scan.ranges_m) == 180  # the directions are regular: every beam keeps its place in time
    assert np.degrees(scan.angle_increment_rad) == pytest.approx(-2.0, abs=1e-4)
    assert np.isposinf(scan.ranges_m[7])
    assert np.linalg.norm(points_of(scan)[0] - [3.0, 0.0]) < 1e-4


def test_faults_are_named(folder):
    (folder / "images" / "first.png").write_bytes(b"x")
    assert "must be the stamp" in refusal(folder)
    (folder / "images" / "first.png").unlink()
    (folder / "rig.toml").unlink()
    assert "no rig.toml" in refusal(folder)
    other = folder / "other.toml"
    other.write_text(RIG.replace("width_px = 64", "width_px = 80"))
    assert "K is for 80x48 px but" in refusal(folder, rig=other)


def test_folder_toml(folder):
    (folder / "folder.toml").write_text("range_max_m = 12\nscan_time_s = 0.1\n")
    scan = of(play(folder)[0], "lidar/scan")[0].message
    assert (scan.range_max_m, scan.time_increment_s) == (12.0, pytest.approx(0.1 / 180))
    for text, words in [
        ("range_max = 3", "unknown option 'range_max'"),
        ("range_max_m = 'far'", "'far' is not a number"),
        ("range_max_m = nan", "is not a number"),
        ("[", "not a TOML file"),
    ]:
        (folder / "folder.toml").write_text(text)
        assert words in refusal(folder)


def test_a_scan_is_needed_unless_said_otherwise(folder):
    for file in (folder / "lasers").iterdir():
        file.unlink()
    assert "has no scan" in refusal(folder)
    sourced, _ = play(folder, without=("scan",))
    assert len(of(sourced, "camera/image")) == 5


def test_broken_files_are_counted(folder):
    next((folder / "lasers").iterdir()).write_bytes(b"rubbish")
    next((folder / "images").iterdir()).write_bytes(b"rubbish")
    # The first picture tells the size, so take care not to break that one.
    sourced, problems = play(folder)
    assert len(of(sourced, "lidar/scan")) == 4
    assert any("scan: 1 message refused" in problem for problem in problems)


def test_csv_scans(folder):
    for file in (folder / "lasers").iterdir():
        file.unlink()
    settings = "# angle_min_rad = -1.0\n# angle_increment_rad = 0.5\n# range_min_m = 0.1\n# range_max_m = 9\n"
    (folder / "scans.csv").write_text(
        settings + f"{STAMP_NS}, 1, 2.5, inf, nan, 3\n{STAMP_NS + 5}, 1,2,3,4,5\n"
    )
    scans = of(play(folder)[0], "lidar/scan")
    assert len(scans) == 2
    np.testing.assert_array_equal(
        scans[0].message.ranges_m, np.array([1, 2.5, np.inf, np.nan, 3], np.float32)
    )
    assert scans[0].message.angle_min_rad == -1.0
    for text, words in [
        ("1, 2\n", "missing: angle_min_rad"),
        (settings + "x, 2\n", "line 5: 'x' is not a stamp"),
        ("# range_mix_m = 3\n", "unknown setting 'range_mix_m'"),
        ("# range_max_m = far\n", "'far' is not a number"),
    ]:
        (folder / "scans.csv").write_text(text)
        with pytest.raises(UserError, match=words):
            CsvScans(folder / "scans.csv")


@pytest.mark.parametrize("binary", [False, True])
def test_pcd(tmp_path, binary):
    points = np.random.default_rng(0).normal(0, 3, (50, 2)).astype(np.float32)
    write_pcd(tmp_path / "a.pcd", points, binary)
    assert np.allclose(xy_from_pcd((tmp_path / "a.pcd").read_bytes(), "a.pcd"), points, atol=1e-5)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200))
def test_rubbish_in_pcd_raises_value_errors_only(data):
    for content in (
        data,
        b"FIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 9\nDATA binary\n" + data,
        b"FIELDS x y\nDATA ascii\n" + data,
    ):
        try:
            xy_from_pcd(content, "x.pcd")
        except ValueError as error:
            assert str(error)  # noqa: PT017


@settings(max_examples=100, deadline=None)
@given(
    st.integers(30, 400),
    st.floats(-3, 3),
    st.sampled_from([-1, 1]),
    st.floats(0.5, 1.0),
    st.integers(0, 1000),
)
def test_regular_scans_keep_their_points(beams, start, turn, share, seed):
    """To the micrometre at 10 m, whatever the direction, the start and the missing beams."""
    rng = np.random.default_rng(seed)
    angles = start + turn * np.arange(beams) * 2 * np.pi / beams
    ranges = rng.uniform(0.5, 10.0, beams)
    points = np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=1)
    missing = rng.random(beams) > share
    missing[:2] = False
    points[missing] = 0.0
    scan = scan_from_points(points, 0.0, 20.0, 0.1)
    assert len(scan["ranges_m"]) == beams
    found = scan["angle_min_rad"] + scan["angle_increment_rad"] * np.arange(beams)
    error = np.abs(np.angle(np.exp(1j * (found - angles))))
    assert error.max() < 1e-6
    assert np.isposinf(scan["ranges_m"][missing]).all()


def test_shuffled_points_land_within_an_eighth_of_their_spacing():
    rng = np.random.default_rng(0)
    angles = np.radians(np.arange(0, 360, 0.5)) + rng.uniform(-0.003, 0.003, 720)
    points = np.stack([5.0 * np.cos(angles), 5.0 * np.sin(angles)], axis=1)[rng.permutation(720)]
    scan = scan_from_points(points, 0.0, 20.0, 0.1)
    beams = scan["angle_min_rad"] + scan["angle_increment_rad"] * np.arange(len(scan["ranges_m"]))
    hit = beams[np.isfinite(scan["ranges_m"])]
    nearest = np.abs(np.angle(np.exp(1j * (angles[:, None] - hit[None])))).min(axis=1)
    assert nearest.max() < np.radians(0.5) / 8 + 1e-4
    assert scan["time_increment_s"] == 0.0


def test_real_pairs_of_picture_and_scan(shared_dir, tmp_path):
    rig = tmp_path / "rig.toml"
    text = (
        RIG.replace("= 64", "= 640")
        .replace("= 48", "= 480")
        .replace("31.5", "331.11")
        .replace("23.5", "229.43")
    )
    rig.write_text(text.replace("fx_px = 70.0", "fx_px = 519.27").replace("fy_px = 70.0", "fy_px = 518.89"))
    path = shared_dir / "data/acfr_2dlidar"
    sourced, problems = play(path, rig=rig)
    assert problems == []
    scans = of(sourced, "lidar/scan")
    assert len(scans) == len(of(sourced, "camera/image")) == 5
    for item in scans:
        truth = xy_from_pcd((path / "lasers" / f"{item.message.stamp_ns}.pcd").read_bytes(), "")
        truth = truth[np.hypot(*truth.T) > 0]
        found = points_of(item.message)
        distance = np.linalg.norm(truth[:, None] - found[None], axis=2).min(axis=1)
        near = np.hypot(*truth.T) < 1.5
        assert distance[near].max() < 0.003
        assert distance.max() < 0.02


def test_expected_messages(folder):
    node = ReplayNode(ReplayConfig(data=folder))
    assert node.expected_messages() == 20
    node.close()
