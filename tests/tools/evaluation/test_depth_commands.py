"""The commands `eval depth`, `depth`, `bench depth` and `calibrate` on a short drive."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from beamsplat.common.geometry.trajectory import Trajectory, write_tum
from beamsplat.tools.cli.main import app
from beamsplat.tools.evaluation.metrics import MethodErrors, every_third, every_third_block
from tests.tools.evaluation.conftest import pose

runner = CliRunner()


def run(*arguments):
    return runner.invoke(app, [str(a) for a in arguments], env={"COLUMNS": "200"})


def figures(*arguments):
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="session")
def poses(drive):
    """The drive's true poses as a TUM file, 50 Hz."""
    stamps = 1_000_000_000 + np.arange(0, 6 * 50, dtype=np.int64) * 20_000_000
    path = drive / "true.tum"
    write_tum(path, Trajectory(stamps, np.array([pose(int(s)) for s in stamps])), "T_map_body")
    return path


@pytest.mark.slow
def test_eval_depth_estimates_poses_and_has_all_figures(drive):
    report = figures("eval", "depth", drive / "rec", "--truth", drive, "--source", "stixel")
    assert report["poses"] == "our SLAM"
    assert report["default"] == "field"
    field = report["field"]
    for key in (
        "rmse_m", "absrel", "delta1", "coverage", "frames", "beams_rmse_m", "heldout_median_m", "heldout_p90_m",
        "heldout_excluded", "within_1sigma", "within_3sigma", "sigma_median_m",
    ):  # fmt: skip
        assert np.isfinite(field[key]), key
    assert field["frames"] == 5
    assert field["absrel"] < 0.05
    assert field["heldout_median_m"] < 0.03
    assert report["ratio"]["frames"] == 5
    rows = {row["part"]: row for row in report["breakdown"]["methods"]["field"]["height"]}
    assert "there is no groundtruth.txt" in report["breakdown"]["heights"]["poses"]
    assert sum(row["share"] for row in rows.values()) == pytest.approx(1.0)
    assert rows["floor"]["within_5cm"] > 0.9
    assert rows["1.2 m to the ceiling"]["share"] > 0.05


def test_eval_depth_prints_the_parts_of_the_image(drive, poses):
    result = run(
        "eval", "depth", drive / "rec", "--truth", drive, "--poses", poses, "--source", "none", "--no-heldout"
    )
    assert result.exit_code == 0, result.output
    for text in (
        "1.2 m to the ceiling",
        "depth edges",
        "2 to 4 m",
        "share_of_l1",
        "body on the floor, at 0.00 m",
    ):
        assert text in result.output


def test_depth_writes_panels(drive, poses, tmp_path):
    result = run(
        "depth", drive / "rec", "--out", tmp_path, "--poses", poses, "--source", "stixel", "--truth", drive,
        "--every", 3,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    files = sorted(tmp_path.glob("*.png"))
    assert len(files) == 2
    assert cv2.imread(str(files[0])).shape == (240, 5 * 320, 3)


def test_a_clock_offset_is_estimated_and_reported(drive, poses):
    right = figures("calibrate", "time", drive / "rec", "--poses", poses)
    assert abs(right["clock_ms"]) < 5.0
    wrong = figures("calibrate", "time", drive / "rec", "--poses", poses, "--shift-ms", 80)
    assert wrong["clock_ms"] == pytest.approx(-80.0, abs=5.0)
    assert "clock is wrong" in wrong["status"]


def test_extrinsics_report_unobservable_parameters(drive, poses):
    report = figures("calibrate", "extrinsics", drive / "rec", "--poses", poses)
    assert abs(report["yaw_deg"]) < 0.3
    assert any("z:" in reason for reason in report["not_observable"])


def test_bench_depth_reports_the_source_alone_and_the_whole():
    report = figures("bench", "depth", "--source", "stixel", "--frames", 6)
    assert report["fps_source_alone"] > report["fps_one_core"] > 0.0
    assert report["cpu_ms_keyframe"] > 0.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("eval", "depth", "{drive}/rec", "--truth", "{drive}/rec", "--source", "none"), "holds no truth"),
        (("calibrate", "extrinsics", "{drive}", "--target", "board"), "--rig"),
        (("calibrate", "extrinsics", "{drive}/rec", "--target", "wall"), "motion or board"),
        (("eval", "depth", "{drive}/rec", "--truth", "{drive}", "--source", "nonsense"), "stixel"),
        (
            ("eval", "depth", "{drive}/rec", "--truth", "{drive}", "--weights", "{drive}/no.onnx"),
            "train aggregator",
        ),
    ],
)
def test_errors_name_the_cause(drive, arguments, words):
    result = run(*(a.format(drive=drive) for a in arguments))
    assert result.exit_code != 0
    assert words in result.output + str(result.exception)


def test_calibration_with_real_boards_aligns_beams_with_the_boards_edges(shared_dir, tmp_path):
    folder = shared_dir / "data/acfr_2dlidar"
    if not folder.exists():
        pytest.skip("needs the recorded boards")
    rig = tmp_path / "rig.toml"
    rig.write_text(
        "[camera]\nwidth_px = 640\nheight_px = 480\nfx_px = 519.27\nfy_px = 518.89\ncx_px = 331.11\n"
        'cy_px = 229.43\ndistortion_model = "plumb_bob"\n'
        "distortion = [0.1142, 0.1934, -0.0027, 0.0037, -1.0954]\n"
        "[camera.mount]\nxyz_m = [0.0, 0.0, 0.2]\nrpy_deg = [0.0, 0.0, 0.0]\n"
        "[lidar.mount]\nxyz_m = [-0.05, 0.05, 0.18]\nrpy_deg = [0.0, 0.0, -6.0]\n"
    )
    report = figures("calibrate", "extrinsics", folder, "--target", "board", "--rig", rig)
    assert report["yaw_deg"] == pytest.approx(-1.31, abs=0.3)
    assert report["x_m"] == pytest.approx(-0.017, abs=0.01)
    assert report["z_m"] == pytest.approx(-0.092, abs=0.01)
    assert report["edges"] >= 8
    assert report["edge_error_px"] < 3.0 < report["edge_error_before_px"]


def test_a_third_of_the_beams_is_held_out_either_way():
    assert every_third(720).mean() == pytest.approx(1 / 3)
    assert every_third_block(720, np.radians(0.5)).mean() == pytest.approx(1 / 3, abs=0.02)


def test_pixels_without_depth_lower_only_the_coverage():
    truth = np.full((4, 4), 2.0, np.float32)
    depth = truth + 0.1
    depth[:2] = np.nan
    errors = MethodErrors()
    errors.add_dense(depth, np.full((4, 4), 0.2, np.float32), truth)
    summary = errors.summary({})
    assert summary["coverage"] == 0.5
    assert summary["rmse_m"] == pytest.approx(0.1, rel=1e-4)
    assert summary["dense_within_1sigma"] == 1.0
