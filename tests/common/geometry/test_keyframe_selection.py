"""Keyframes are taken by motion, overlap and sharpness, and by nothing else."""

import cv2
import numpy as np
import pytest

from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.keyframe_selection import (
    KeyframeSelector,
    SelectionSettings,
    overlap,
    sharpness,
)
from beamsplat.common.geometry.transforms import make_transform, se2_to_se3, so3_exp

FOV_RAD = (1.09, 0.85)
HALF = np.tan(0.5 * np.array(FOV_RAD))
T_BODY_CAMERA = camera_mount(0.1, 0.0, 0.45)
SHARP = cv2.resize(
    np.random.default_rng(0).integers(0, 255, (60, 80), dtype=np.uint8),
    (320, 240),
    interpolation=cv2.INTER_NEAREST,
)
BLURRED = cv2.GaussianBlur(SHARP, (0, 0), 6.0)


def pose(x_m=0.0, yaw_rad=0.0):
    return se2_to_se3(np.array([x_m, 0.0, yaw_rad])) @ T_BODY_CAMERA


def keys(poses, pictures=None, **settings):
    selector = KeyframeSelector(FOV_RAD, SelectionSettings(**settings))
    images = [SHARP] * len(poses) if pictures is None else pictures
    found = [selector.decide(T, sharpness(image)) for T, image in zip(poses, images)]
    return [i for i, d in enumerate(found) if d.selected], [d.reason for d in found]


def test_motion_decides_on_both_sides_of_the_threshold():
    taken, _ = keys([pose(0.0), pose(0.299), pose(0.301), pose(0.55), pose(0.602)], distance_m=0.3)
    assert taken == [0, 2, 4]
    taken, reasons = keys([pose(), pose(yaw_rad=0.25), pose(yaw_rad=0.27)], angle_rad=0.26)
    assert taken == [0, 2]
    assert reasons[2] == "turned"


def test_little_overlap_decides_where_motion_does_not():
    _, reasons = keys(
        [pose(), pose(yaw_rad=0.2), pose(yaw_rad=0.5)], angle_rad=3.0, distance_m=9.0, least_overlap=0.7
    )
    assert reasons == ["first image", "too close to the last keyframe", "little overlap"]


def test_waits_for_a_sharp_picture_but_not_for_ever():
    poses = [pose(0.05 * i) for i in range(20)]
    pictures = [SHARP] * 20
    for i in (6, 7):
        pictures[i] = BLURRED
    taken, reasons = keys(poses, pictures, distance_m=0.3, patience=4)
    assert taken[:2] == [0, 8]
    assert "blurred" in reasons[6]
    taken, _ = keys(poses, [SHARP] * 3 + [BLURRED] * 17, distance_m=0.3, patience=3)
    assert taken[1] == 8  # due at 6, the third image is taken


def test_a_selection_that_is_withdrawn_is_made_up_for_by_the_next_image():
    selector = KeyframeSelector(FOV_RAD, SelectionSettings(distance_m=0.3))
    assert selector.decide(pose(0.0), 1.0).selected
    assert selector.decide(pose(0.4), 1.0).selected
    selector.withdraw(pose(0.4))
    assert selector.decide(pose(0.42), 1.0).selected
    assert not selector.decide(pose(0.45), 1.0).selected


def test_a_selection_that_is_withdrawn_after_the_next_one_changes_nothing():
    selector = KeyframeSelector(FOV_RAD, SelectionSettings(distance_m=0.3))
    assert selector.decide(pose(0.0), 1.0).selected
    assert selector.decide(pose(0.4), 1.0).selected
    selector.withdraw(pose(0.0))
    assert not selector.decide(pose(0.45), 1.0).selected


def test_a_broken_pose_is_refused():
    taken, reasons = keys([np.full((4, 4), np.nan), pose()])
    assert taken == [1]
    assert "rigid" in reasons[0]


def test_sharpness_falls_with_blur_and_not_with_contrast():
    assert sharpness(SHARP) > 3.0 * sharpness(BLURRED)
    assert sharpness((SHARP // 2 + 60).astype(np.uint8)) == pytest.approx(sharpness(SHARP), rel=0.2)


def test_overlap_of_a_turn_is_what_remains_in_view():
    assert overlap(np.eye(4), HALF, 2.0) == 1.0
    assert overlap(make_transform(so3_exp([0.0, np.pi, 0.0]), np.zeros(3)), HALF, 2.0) == 0.0
    half_turned = overlap(
        make_transform(so3_exp([0.0, FOV_RAD[0] / 2, 0.0]), np.zeros(3)), HALF, 2.0, grid=81
    )
    assert 0.35 < half_turned < 0.55


def test_settings_are_checked():
    with pytest.raises(ValueError, match="positive"):
        SelectionSettings(distance_m=0.0)
    with pytest.raises(ValueError, match="patience"):
        SelectionSettings(patience=0)
