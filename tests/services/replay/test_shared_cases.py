"""The inputs of ../shared/cases, which people have met: the right result, or a sentence (its README has the table).

The same kinds are built in test_cases_files.py, test_cases_images.py and test_scan_cases.py; here the files
themselves are read by the commands of the user.
"""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.errors import UserError
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.tools.cli.main import app
from beamsplat.tools.evaluation.slam import errors_against_truth
from beamsplat.tools.system.assembly import build_node

pytestmark = pytest.mark.slow
LARGEST_ERROR_M = 0.008  # 3 times that of the clean recording; of the published poses:
LARGEST_ONLINE_ERROR_M = 0.03
ROI = slice(22, 98), slice(30, 130)  # of case c08


@pytest.fixture
def cases(shared_dir):
    folder = shared_dir / "cases"
    if not folder.is_dir():
        pytest.skip("needs the shared cases, which are not part of the repository")
    return folder


def info(path, *options):
    """What `beamsplat info` prints, and its error; both in one line."""
    result = CliRunner().invoke(app, ["info", str(path), *options])
    assert result.exception is None or isinstance(result.exception, UserError | SystemExit)
    error = str(result.exception) if isinstance(result.exception, UserError) else ""
    return " ".join(result.output.split()), error


def slam_error_m(path, tmp_path, shared_dir, *options):
    """Position error (RMSE) of the optimised trajectory of `beamsplat slam`, and the number of its poses."""
    out = tmp_path / "map"
    result = CliRunner().invoke(app, ["slam", str(path), "--out", str(out), "--json", *options])
    if isinstance(result.exception, UserError):
        raise result.exception
    assert result.exception is None
    errors = errors_against_truth(out, shared_dir / "data/house_a/groundtruth.txt")
    figures = json.loads((out / "figures.json").read_text())
    if figures["scans_ok"] == figures["scans"]:  # after a gap, published poses are "lost" until they are tied
        assert errors["online_ate_first_pose_rmse_m"] < LARGEST_ONLINE_ERROR_M
    return errors["ate_first_pose_rmse_m"], errors["poses"]


LIDAR_CASES = {
    # folder: number of scans, words of `info`
    "c00_clean/lidar": (199, ()),
    "c01_ccny_index/small.bag": (49, ()),
    "c10_scans_all_refused/time_increment": (49, ("/scan: 49 messages repaired: time_increment = 153333",)),
    # The lidar turns, but time_increment is 0: these scans cannot be deskewed, which is said.
    "c10_scans_all_refused/range_max_inf": (49, ("range_max = inf", "time_increment = 0")),
    "c10_scans_all_refused/clockwise": (49, ("time_increment = -",)),
    "c11_mcap_chunks/bag": (136, ("damaged", " s ")),
    "c12_compressed_split/half": (199, ("bag_0.mcap.zstd",)),
    "c12_compressed_split/nometa": (199, ()),
    "c17_stamps/same": (199, ("all scans have the same stamp",)),
    "c17_stamps/folder_us": (199, ("microseconds",)),
    "c18_increment/mirrored": (199, ("angle_increment = ",)),
    "c20_left_over_files/folder": (49, ("drive.orig.bag",)),
    "c20_left_over_files/drive.bag.active": (49, ("the recorder has not closed this file",)),
}


@pytest.mark.parametrize("case", LIDAR_CASES)
def test_scans_of_the_case_give_the_clean_map(cases, shared_dir, tmp_path, case):
    count, words = LIDAR_CASES[case]
    said, error = info(cases / case)
    assert error == ""
    for word in words:
        assert word in said
    error_m, poses = slam_error_m(cases / case, tmp_path, shared_dir)
    assert error_m < (0.03 if case.endswith("range_max_inf") else LARGEST_ERROR_M)
    assert abs(poses - count) <= 2


def test_the_transforms_beside_the_chosen_scan_are_used(cases, shared_dir, tmp_path):
    options = ("--scan-topic", "/robot1/scan", "--odometry-topic", "/robot1/odom")
    error_m, _ = slam_error_m(cases / "c03_two_robots_tf/bag", tmp_path, shared_dir, *options)
    assert error_m < LARGEST_ERROR_M


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("c04_optical_scan/lidar", ("/scan", "tilted by 90 degrees")),
        ("c04_optical_scan/camera", ("/scan", "tilted by 90 degrees")),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_reason(cases, shared_dir, tmp_path, case, words):
    error = info(cases / case)[1]
    for word in words:
        assert word in error
    with pytest.raises(UserError) as refused:
        slam_error_m(cases / case, tmp_path, shared_dir)
    assert str(refused.value) == error


def test_a_bag_of_format_1_2_is_read(cases):
    said, error = info(cases / "c02_bag_v12/demo_v12.bag")
    assert error == ""
    assert "/scan LaserScan 123 10.0" in said


def absrel(path, shared_dir, crop=None):
    """Mean AbsRel of the fused depth against the truth of house_a, and the number of fused images."""
    nodes = {
        "replay": {"data": str(path)}, "localization": {"kind": "lidar"}, "depth": {"source": "stixel"}, "fusion": {},
    }  # fmt: skip
    fused, errors = {}, []

    def on_message(envelope):
        if envelope.topic == "fusion/depth" and envelope.message.status == "ok":
            fused[envelope.message.stamp_ns] = envelope.message.depth_m

    Lockstep([build_node(Deployment(nodes=nodes), name) for name in nodes], on_message).run()
    for stamp_ns, depth in fused.items():
        file = shared_dir / f"data/house_a/depth_gt/{stamp_ns}.png"
        if file.exists():
            truth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[1::4, 1::4] / 1000.0  # 640x480 to 160x120
            truth = truth[crop] if crop else truth
            known = (truth > 0) & np.isfinite(depth)
            errors.append(np.mean(np.abs(depth - truth)[known] / truth[known]))
    return float(np.mean(errors)), len(fused)


CAMERA_CASES = {
    # folder: ratio of the images of the clean recording, words of `info`
    "c06_exif/exif3": (1.0, ()),
    "c06_exif/exif6": (1.0, ()),
    "c08_roi_binning/roi": (1.0, ()),
    "c09_encodings/uyvy": (0.15, ()),
    "c09_encodings/bayer": (0.15, ()),
    "c09_encodings/step": (0.15, ("step = 320",)),
    "c14_zero_quaternion/bag": (0.15, ("rotation = [0 0 0 0]",)),
    "c15_picture_size_changes/bag": (1.0, ("width, height = 80x60",)),
}


@pytest.fixture(scope="module")
def clean_absrel(shared_dir):
    return absrel(shared_dir / "cases/c00_clean/camera", shared_dir)


@pytest.mark.parametrize("case", CAMERA_CASES)
def test_images_of_the_case_give_the_clean_depth(cases, shared_dir, clean_absrel, case):
    ratio, words = CAMERA_CASES[case]
    said, error = info(cases / case)
    assert error == ""
    for word in words:
        assert word in said
    found, count = absrel(cases / case, shared_dir, ROI if case.endswith("roi") else None)
    print(f"{case}: AbsRel {found:.4f} of {count} images; clean {clean_absrel[0]:.4f} of {clean_absrel[1]}")
    assert found < 1.5 * clean_absrel[0]
    assert count >= 0.9 * ratio * clean_absrel[1]
