"""The check at every start: planted faults of clock, mount and lidar are named, and a right robot is left alone."""

import numpy as np
import pytest

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import inverse, se2_to_se3, so3_exp, transform_points
from beamsplat.services.fusion.calibration.diagnosis import WheelEvidence, compare_with_wheels
from beamsplat.services.fusion.calibration.motion import TrackedPair, apply_correction
from beamsplat.services.fusion.calibration.startup_check import StartupCheck, check_calibration
from beamsplat.tools.bench.diagnosis import bench_diagnosis
from tests.services.fusion.room import CAMERA, LIDAR_Z, T_BODY_CAMERA, render, scan
from tests.services.fusion.test_calibration import MOUNT, _pose
from tests.services.fusion.test_calibration import _drive as _corners

T_BODY_LIDAR = np.eye(4)
SMALL = Pinhole(265.0, 265.0, 159.5, 119.5, 320, 240)
FLIP = np.diag([1.0, -1.0, 1.0, 1.0])
HALF_TURN = np.eye(4)
HALF_TURN[:3, :3] = so3_exp(np.array([0.0, 0.0, np.pi]))


def _drive(mount, clock_s=0.0):
    """The drive of the tests of the calibration, without corners under the floor."""
    return _corners(mount, clock_s, lowest_m=0.25)


def _check(pairs, pose=_pose, mount=MOUNT, scans=(), wheels=None):
    return check_calibration(pairs, list(scans), pose, mount, T_BODY_LIDAR, SMALL, wheels)


def test_a_right_robot_is_ok_with_figures():
    health = _check(_drive(MOUNT))
    assert health.status == "ok"
    assert abs(health.clock_ms) < 3.0
    assert health.misfit_px < 0.5
    assert "calibration ok" in health.line
    assert "ms" in health.line


@pytest.mark.parametrize("clock_ms", [-80, 60])
def test_a_wrong_clock_is_named_with_its_amount(clock_ms):
    health = _check(_drive(MOUNT, clock_ms * 1e-3))
    assert f"add {clock_ms} +-" in health.status or abs(health.clock_ms - clock_ms) < 5.0
    assert "clock is wrong" in health.status


@pytest.mark.parametrize(("axis", "name"), [(2, "pitch"), (3, "yaw")])
def test_a_turned_camera_is_named_with_its_axis(axis, name):
    planted = np.zeros(6)
    planted[axis] = np.radians(2.0)
    health = _check(_drive(MOUNT), mount=apply_correction(MOUNT, planted))
    assert f"the camera's {name} is wrong" in health.status
    assert health.turn_deg[axis - 1] == pytest.approx(-2.0, abs=0.3)


@pytest.mark.parametrize(
    ("change", "words"), [(FLIP, "mirrored (upside down"), (HALF_TURN, "turned round by 180 degrees")]
)
def test_poses_of_a_wrongly_mounted_lidar_are_told_by_the_camera(change, words):
    """The scans fit such poses: they were made from them. Images do not."""
    health = _check(_drive(MOUNT), pose=lambda stamp: change @ _pose(stamp) @ inverse(change))
    assert words in health.status
    assert "rig" in health.status


def test_a_mirrored_lidar_is_told_by_poses_from_elsewhere():
    times = np.arange(0, 24) * 1_000_000_000
    scans = []
    for stamp in times:
        T = _pose(stamp)
        points = scan(T, np.random.default_rng(1)).points_body_m - [0.0, 0.0, LIDAR_Z]
        scans.append((points * [1.0, -1.0, 1.0], T))
    assert "mirrored" in _check(_drive(MOUNT), scans=scans).status
    right = [(points * [1.0, -1.0, 1.0], T) for points, T in scans]
    assert _check(_drive(MOUNT), scans=right).status == "ok"


def _run(pairs, clock_ns=0):
    """A drive in the room, its images at 8 Hz; the check's result."""
    wanted = StartupCheck(CAMERA, T_BODY_CAMERA, T_BODY_LIDAR, pairs)
    for k in range(200):
        stamp = k * 125_000_000
        T = _room_pose(stamp)
        wanted.add_pose(stamp, T)
        if k % 2 == 0 and stamp >= 500_000_000:
            image, _ = render(_room_pose(stamp + clock_ns))
            wanted.add_image(stamp, image, T)
        job = wanted.job()
        if job is not None:
            assert wanted.job() is None
            return job()
    raise AssertionError(wanted.progress)


def _room_pose(stamp_ns):
    s = stamp_ns * 1e-9
    return se2_to_se3(np.array([0.12 * s, 0.3 * np.sin(0.5 * s), 0.25 * np.sin(1.1 * s)]))


def test_images_of_a_room_pass_the_check_and_late_ones_do_not():
    assert _run(16).status == "ok"
    assert "clock is wrong" in _run(16, clock_ns=120_000_000).status


def test_a_clock_that_is_set_back_starts_the_check_anew():
    started = StartupCheck(CAMERA, T_BODY_CAMERA, T_BODY_LIDAR, 4)
    points = transform_points(np.eye(4), np.random.default_rng(0).uniform(-3, 3, (80, 3)))
    for stamp in (10, 20, 30):
        started.add_pose(stamp, np.eye(4))
    started.add_scan(points, np.eye(4))
    started.add_pose(5, np.eye(4))
    assert started.job() is None
    assert "0 of 4" in started.progress


def test_poses_are_bounded_while_too_few_images_can_be_used():
    check = StartupCheck(CAMERA, MOUNT, T_BODY_LIDAR)
    rays = np.ones((20, 3))
    check._pairs.append(TrackedPair(0, 10**9, rays, rays))  # then the robot stands still
    for i in range(36_000):  # an hour
        check.add_pose(i * 10**8, np.eye(4))
    assert len(check._poses) == len(check._stamps) <= 12_000
    assert not check._pairs  # there are no poses of its time any more


def _changed(pairs, change):
    """The rays [N, 3] of all corners, changed."""
    return [TrackedPair(p.stamp_a_ns, p.stamp_b_ns, change(p.rays_a), change(p.rays_b)) for p in pairs]


@pytest.mark.parametrize(
    ("cause", "change"),
    [
        ("images upside down", lambda rays: rays * [-1, -1, 1]),
        ("principal point", lambda rays: np.add(rays, [0.2, 0.1, 0.0])),
        ("K", lambda rays: rays * [1.3, 1.3, 1.0]),
        ("distortion", lambda rays: rays * (1 - 0.25 * np.sum(rays[:, :2] ** 2, axis=1, keepdims=True) * [1, 1, 0])),
    ],
)  # fmt: skip
def test_a_fault_of_the_images_is_not_called_an_offset(cause, change):
    """Before: EXIF rotation was "lidar mirrored", a region of interest "clock", missing distortion "yaw"."""
    wheels = WheelEvidence("ok", 0.0)
    health = _check(_changed(_drive(MOUNT), change), wheels=wheels)
    assert health.cause == cause
    assert np.isnan(health.clock_ms)


def test_the_wheels_tell_a_mirrored_image_from_a_mirrored_lidar():
    stamps = np.arange(0, 30 * 10**9, 10**8)
    wheels = np.array([_pose(int(s)) for s in stamps])
    flipped = FLIP @ wheels @ FLIP
    assert compare_with_wheels(stamps, wheels, _pose, T_BODY_LIDAR).mounting == "ok"
    mirrored = compare_with_wheels(stamps, flipped, _pose, T_BODY_LIDAR)
    assert mirrored.mounting == "lidar mirrored"
    turned = HALF_TURN @ wheels @ inverse(HALF_TURN)
    assert compare_with_wheels(stamps, turned, _pose, T_BODY_LIDAR).mounting == "lidar turned"
    images = _changed(_drive(MOUNT), lambda rays: rays * [-1, 1, 1])
    assert _check(images, wheels=WheelEvidence("ok", 0.0)).cause == "images mirrored"
    assert _check(_drive(MOUNT), lambda s: FLIP @ _pose(s) @ FLIP, wheels=mirrored).cause == "lidar mirrored"


def test_poses_of_another_drive_give_no_advice():
    rng = np.random.default_rng(2)
    noise = _changed(
        _drive(MOUNT),
        lambda rays: rays + np.column_stack([rng.normal(0, 0.1, (len(rays), 2)), np.zeros(len(rays))]),
    )
    health = _check(noise)
    assert health.cause in ("unknown", "unchecked")
    assert np.isnan(health.clock_ms)


@pytest.mark.slow
def test_the_right_cause_is_named_for_eleven_of_twelve_planted_faults(shared_dir):
    found = list(bench_diagnosis(shared_dir / "data" / "house_a"))
    assert found[0].health.status == "ok"
    wrong = [row.fault.name for row in found if not row.right]
    assert len(found) == 13
    assert len(wrong) <= 1, wrong
