"""Sources without weights: stixel, none, recorded; and the metrics of the evaluation."""

import cv2
import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.services.depth.source import DepthInput, check_depth_map, make_source
from beamsplat.tools.evaluation.metrics import (
    MethodErrors,
    confirmed_by_truth,
    every_third,
    every_third_block,
)
from tests.services.fusion.room import CAMERA, T_BODY_CAMERA, render, scan

POSE = se2_to_se3(np.array([0.3, 0.2, 0.1]))


def _view(**changes):
    image, _ = render(POSE)
    return DepthInput(
        **{
            "stamp_ns": 5,
            "image_rgb": image,
            "camera": CAMERA,
            "T_body_camera": T_BODY_CAMERA,
            "beams": scan(POSE),
            "floor_known": True,
        }
        | changes
    )


def test_stixel_is_exact_on_floor_and_on_what_the_lidar_sees():
    _, truth = render(POSE)
    values = make_source("stixel").estimate(_view()).values
    error = np.abs(values - truth) / truth
    assert np.median(error[120:]) < 0.005
    assert np.mean(error[130:] < 0.01) > 0.9
    assert np.mean(error[:60] < 0.01) < 0.6  # no ceiling, and the wall behind the cupboard is unseen


def test_without_a_known_floor_only_the_beams_speak():
    values = make_source("stixel").estimate(_view(floor_known=False)).values
    assert np.nanmin(values[200]) > 1.2


def test_none_answers_nothing_and_recorded_answers_what_is_in_the_folder(tmp_path):
    assert np.isnan(make_source("none").estimate(_view()).values).all()
    _, truth = render(POSE)
    cv2.imwrite(str(tmp_path / "5.png"), np.rint(truth * 1000).astype(np.uint16))
    np.save(tmp_path / "9000000000.npy", truth[::2, ::2])
    source = make_source("recorded", {"folder": tmp_path})
    assert np.abs(source.estimate(_view()).values - truth).max() < 0.001
    assert "no recorded depth" in source.estimate(_view(stamp_ns=4_000_000_000)).status
    assert source.estimate(_view(stamp_ns=9_000_000_000)).values.shape == CAMERA.shape
    with pytest.raises(UserError, match="is not a folder"):
        make_source("recorded", {"folder": tmp_path / "absent"})


def test_judge_says_what_is_wrong_with_a_map():
    rng = np.random.default_rng(0)
    assert check_depth_map(rng.uniform(1, 3, (20, 20))) == "ok"
    assert "same value" in check_depth_map(np.full((20, 20), 2.0))
    assert "above zero" in check_depth_map(-rng.uniform(1, 3, (20, 20)))
    assert "only 0%" in check_depth_map(np.full((20, 20), np.nan))


def test_held_out_patterns_are_thirds_of_the_circle():
    assert every_third(720).sum() == 240
    hidden = every_third_block(720, np.radians(0.5))
    assert hidden.sum() == 240
    assert np.all(hidden[:15])
    assert not hidden[15:45].any()


def test_metrics_are_what_they_are_called():
    truth = np.full((10, 10), 2.0, np.float32)
    truth[0] = np.nan
    depth = truth * 1.1
    depth[1] = np.nan
    errors = MethodErrors()
    errors.add_dense(depth, np.full_like(depth, 0.15), truth)
    errors.add_held(
        "third", depth, np.full_like(depth, 0.1), np.array([[3.0, 4.0], [3.0, 1.0]]), np.array([2.0, 2.0])
    )
    summary = errors.summary({"third": 0.25})
    assert summary["rmse_m"] == pytest.approx(0.2, rel=1e-5)
    assert summary["absrel"] == pytest.approx(0.1, rel=1e-5)
    assert summary["delta1"] == 1.0
    assert summary["coverage"] == pytest.approx(80 / 90)
    assert summary["dense_within_1sigma"] == 0.0
    assert summary["dense_within_3sigma"] == 1.0
    assert summary["heldout_beams"] == 1
    assert summary["heldout_median_m"] == pytest.approx(0.2, rel=1e-5)
    assert summary["within_3sigma"] == 1.0
    assert summary["heldout_excluded"] == 0.25


def test_beams_that_the_truth_does_not_confirm_are_told():
    truth = np.full((10, 10), 2.0, np.float32)
    uv = np.array([[1.0, 1.0]] * 4)
    assert confirmed_by_truth(truth, uv, np.array([2.0, 2.089, 2.091, 1.0])).tolist() == [
        True,
        True,
        False,
        False,
    ]


def test_images_that_wait_in_vain_for_their_poses_are_counted():
    from beamsplat.common.messages import CameraModel, Image, LidarModel, Rig
    from beamsplat.services.depth.node import DepthNode

    node = DepthNode(DepthNode.Config(source="stixel"))
    node.configure()
    camera = CameraModel(
        width_px=64, height_px=48, fx_px=50.0, fy_px=50.0, cx_px=31.5, cy_px=23.5, T_body_camera=np.eye(4)
    )
    rig = Rig(stamp_ns=0, camera=camera, lidar=LidarModel(T_body_lidar=np.eye(4)), source="test")
    list(node.on_rig(rig))
    pixels = np.zeros(64 * 48 * 3, np.uint8)
    for k in range(1, 21):  # localization says nothing meanwhile
        image = Image(stamp_ns=k * 10**8, width_px=64, height_px=48, encoding="rgb8", data=pixels)
        assert list(node.on_camera_image(image)) == []
    assert node.overtaken == 12  # eight still wait
    assert "12 images overtaken" in node.detail
