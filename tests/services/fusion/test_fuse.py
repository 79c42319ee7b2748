"""The whole stage in a room whose truth is known: accuracy in metres, and what it refuses."""

import numpy as np
import pytest

from beamsplat.common.geometry.beams import NO_BEAMS
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.services.fusion.fuse import Fusion
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.fusion.relative_pose import epipolar_px, refine_relative_pose
from tests.services.fusion.room import CAMERA, T_BODY_CAMERA, in_map, render, scan


def _path(k):
    return se2_to_se3(np.array([0.12 * k, 0.25 * np.sin(0.4 * k), 0.1 * np.cos(0.4 * k)]))


def _frame(k, **changes):
    T = _path(k)
    image, truth = render(T)
    beams = scan(T, np.random.default_rng(k))
    return FusionInput(
        **{"stamp_ns": k, "image_rgb": image, "T_map_body": T, "beams": beams} | changes
    ), truth


@pytest.fixture(scope="module")
def drive():
    """(fusion after 12 images, its results with truth)."""
    fusion = Fusion(CAMERA, T_BODY_CAMERA, floor_known=True, planar=True)
    results = []
    for k in range(14):
        frame, truth = _frame(k)
        fusion.add_scan(in_map(frame.T_map_body, frame.beams))
        results.append((fusion.fuse(frame, keyframe=k % 2 == 0), truth))
    return fusion, results


def test_depth_of_a_room_is_right_where_the_lidar_cannot_see(drive):
    _, results = drive
    for result, truth in results[8::2]:
        assert result.ok
        known = np.isfinite(result.depth_m)
        error = np.abs(result.depth_m - truth)[known]
        assert known.mean() > 0.95
        assert np.median(error) < 0.02
        assert np.mean(error / truth[known]) < 0.03
        above = (slice(60, 95), slice(100, 220))  # wall above the cupboard, which the beams end at
        assert np.nanmedian(np.abs(result.depth_m - truth)[above]) < 0.1


def test_images_between_keyframes_carry_the_depth_on(drive):
    _, results = drive
    for result, truth in results[9::2]:
        assert result.ok
        error = np.abs(result.depth_m - truth) / truth
        assert np.nanmean(error) < 0.04


def test_sigma_tells_the_error(drive):
    _, results = drive
    share, threefold = [], []
    for result, truth in results[8::2]:
        known = np.isfinite(result.depth_m)
        pull = np.abs(result.depth_m - truth)[known] / result.sigma_m[known]
        share.append(np.mean(pull < 1.0))
        threefold.append(np.mean(pull < 3.0))
    assert np.mean(share) > 0.5
    assert np.mean(threefold) > 0.9


def test_figures_come_with_every_result(drive):
    _, results = drive
    result = results[-1][0]
    assert result.pairs > 50
    assert result.inlier_share > 0.8
    assert result.residual_m < 0.03


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"beams": NO_BEAMS}, "no beams"),
        ({"image_rgb": np.zeros((240, 320, 3), np.uint8)}, "black"),
        ({"image_rgb": np.full((240, 320, 3), 255, np.uint8)}, "overexposed"),
        ({"image_rgb": np.full((240, 320, 3), 120, np.uint8)}, "grey"),
    ],
)
def test_bad_input_is_refused_with_a_sentence_and_no_depth(change, words):
    fusion = Fusion(CAMERA, T_BODY_CAMERA, floor_known=True, planar=True)
    fusion.fuse(_frame(0)[0], keyframe=True)
    result = fusion.fuse(_frame(2, **change)[0], keyframe=True)
    assert words in result.status
    assert np.isnan(result.depth_m).all()
    assert np.isnan(result.sigma_m).all()


def test_a_frozen_camera_is_told_from_a_robot_that_stands():
    fusion = Fusion(CAMERA, T_BODY_CAMERA, floor_known=True, planar=True)
    first, _ = _frame(0)
    assert fusion.fuse(first, keyframe=True).ok
    assert fusion.fuse(first, keyframe=False).ok
    moved, _ = _frame(3, image_rgb=first.image_rgb)
    assert "frozen" in fusion.fuse(moved, keyframe=False).status


def test_beams_that_pass_through_glass_contradict_what_was_seen(drive):
    fusion, _ = drive
    frame, _ = _frame(14)
    through = frame.beams
    beyond = type(through)(through.points_body_m * [2.5, 2.5, 1.0], through.index, through.sigma_m)
    result = fusion.fuse(FusionInput(14, frame.image_rgb, frame.T_map_body, beyond), keyframe=False)
    assert "glass" in result.status
    assert np.isnan(result.depth_m).all()


def test_a_guess_is_used_where_nothing_else_is_known():
    body_in_hand = Fusion(CAMERA, T_BODY_CAMERA, floor_known=False, planar=False)
    frame, truth = _frame(0)
    with_guess = FusionInput(0, frame.image_rgb, frame.T_map_body, frame.beams, truth / 1.5, "metric")
    result = body_in_hand.fuse(with_guess, keyframe=False)
    error = np.abs(result.depth_m - truth) / truth
    assert result.scale == pytest.approx(1.5, rel=0.03)
    assert np.nanmean(error) < 0.12


def test_a_turned_relative_pose_is_put_right_by_tracked_corners():
    rng = np.random.default_rng(0)
    T = np.linalg.inv(_path(4) @ T_BODY_CAMERA) @ (_path(0) @ T_BODY_CAMERA)
    points = np.column_stack([rng.uniform(-1.5, 1.5, 80), rng.uniform(-1, 1, 80), rng.uniform(2, 5, 80)])
    rays_a = points / points[:, 2:]
    moved = points @ T[:3, :3].T + T[:3, 3]
    rays_b = moved / moved[:, 2:] + np.column_stack([rng.normal(0, 0.2 / 265, (80, 2)), np.zeros(80)])
    rays_b[:8, 0] += 0.1  # wrong tracks
    from beamsplat.common.geometry.transforms import so3_exp, so3_log

    wrong = T.copy()
    wrong[:3, :3] = so3_exp(np.array([0.002, 0.006, -0.003])) @ T[:3, :3]
    found = refine_relative_pose(wrong, rays_a, rays_b, 265.0, 0.007, 0.015)
    assert np.degrees(np.linalg.norm(so3_log(found[:3, :3] @ T[:3, :3].T))) < 0.12
    assert np.median(np.abs(epipolar_px(found, rays_a, rays_b, 265.0))) < 0.3
