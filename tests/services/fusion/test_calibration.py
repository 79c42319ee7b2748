"""Calibration: planted errors come back in milliseconds, degrees and centimetres, with honest error bars."""

import numpy as np
import pytest

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import camera_mount, lidar_mount
from beamsplat.common.geometry.transforms import inverse, se2_to_se3, transform_points
from beamsplat.services.fusion.calibration.board import BoardPair, level_mount, solve_board
from beamsplat.services.fusion.calibration.motion import TrackedPair, apply_correction, solve_motion
from beamsplat.services.fusion.calibration.mounting import check_mounting
from tests.services.fusion.room import scan

CAMERA = Pinhole(265.0, 265.0, 159.5, 119.5, 320, 240)
MOUNT = camera_mount(0.1, 0.0, 0.45, pitch_down_rad=0.035)


def _pose(stamp_ns):
    """A drive with changing speed and rate of turn."""
    s = stamp_ns * 1e-9
    return se2_to_se3(
        np.array([0.3 * s, 0.5 * np.sin(0.5 * s), 0.5 * np.sin(0.7 * s) + 0.1 * np.sin(2.1 * s)])
    )


def _drive(mount, clock_s=0.0, count=80, pose=_pose, lowest_m=1.0):
    rng = np.random.default_rng(4)
    pairs = []
    for k in range(count):
        a, b = round(k * 0.4e9), round((k * 0.4 + 0.3) * 1e9)
        T_a, T_b = pose(a) @ mount, pose(b) @ mount
        points = np.column_stack(
            [rng.uniform(-1.5, 1.5, 40), rng.uniform(-1, lowest_m, 40), rng.uniform(1.5, 6, 40)]
        )
        moved = transform_points(inverse(T_b) @ T_a, points)
        noise = np.column_stack([rng.normal(0, 0.15 / 265, (40, 2)), np.zeros(40)])
        rays_b = moved / moved[:, 2:] + noise
        rays_b[:3, :2] += rng.normal(0, 0.1, (3, 2))
        good = moved[:, 2] > 0.3
        shift = round(clock_s * 1e9)
        pairs.append(TrackedPair(a - shift, b - shift, (points / points[:, 2:])[good], rays_b[good]))
    return pairs


@pytest.mark.parametrize("clock_ms", [-200, -80, 0, 80, 200])
def test_a_planted_clock_offset_is_found_within_5_ms(clock_ms):
    found = solve_motion(_drive(MOUNT, clock_ms * 1e-3), _pose, MOUNT, 265.0, ("clock_s",))
    assert 1e3 * found.values[0] == pytest.approx(clock_ms, abs=5.0)
    assert abs(1e3 * found.values[0] - clock_ms) < max(5.0 * 1e3 * found.sigma[0], 1.0)
    assert found.observable[0]


@pytest.mark.parametrize("yaw_deg", [-2.0, 2.0])
def test_a_planted_yaw_error_is_found_within_a_fifth_of_a_degree(yaw_deg):
    planted = np.array([0.0, 0.0, 0.0, np.radians(yaw_deg), 0.0, 0.0])
    wrong = apply_correction(MOUNT, planted)
    found = solve_motion(_drive(MOUNT), _pose, wrong, 265.0)
    assert np.degrees(found.values[3]) == pytest.approx(-yaw_deg, abs=0.2)
    assert found.residual_px < 0.9 * found.residual_before_px
    right = found.mount(wrong)
    assert np.degrees(np.arccos((np.trace(right[:3, :3].T @ MOUNT[:3, :3]) - 1) / 2)) < 0.2


def _arc(stamp_ns):
    """A drive that turns to one side."""
    s = stamp_ns * 1e-9
    return se2_to_se3(np.array([0.5 * np.sin(0.4 * s), 0.5 - 0.5 * np.cos(0.4 * s), 0.4 * s]))


@pytest.mark.parametrize(("pose", "wide"), [(_arc, True), (_pose, False)])
def test_the_error_of_yaw_includes_what_a_fixed_x_does_in_turns_to_one_side(pose, wide):
    mounted = MOUNT.copy()
    mounted[0, 3] += 0.007
    pairs = _drive(mounted, pose=pose)
    found = solve_motion(pairs, pose, MOUNT, 265.0, ("clock_s", "roll_rad", "pitch_rad", "yaw_rad"))
    assert abs(found.values[3]) < 2.0 * found.sigma[3]
    assert (np.degrees(found.sigma[3]) > 0.4) == wide


def test_a_robot_that_drives_straight_tells_no_clock():
    def straight(stamp_ns):
        return se2_to_se3(np.array([0.3e-9 * stamp_ns, 0.0, 0.0]))

    rng = np.random.default_rng(1)
    pairs = []
    for k in range(40):
        a, b = round(k * 0.4e9), round((k * 0.4 + 0.3) * 1e9)
        points = rng.uniform([-1.5, -1, 1.5], [1.5, 1, 6], (40, 3))
        moved = transform_points(inverse(straight(b) @ MOUNT) @ straight(a) @ MOUNT, points)
        noise = np.column_stack([rng.normal(0, 0.2 / 265, (40, 2)), np.zeros(40)])
        pairs.append(TrackedPair(a, b, points / points[:, 2:], moved / moved[:, 2:] + noise))
    found = solve_motion(pairs, straight, MOUNT, 265.0)
    assert not found.observable[0] or abs(found.values[0]) < 1e-6
    assert found.mount(MOUNT)[:2, 3] == pytest.approx(MOUNT[:2, 3], abs=0.03)


def test_too_little_data_is_said():
    with pytest.raises(ValueError, match="pairs of images"):
        solve_motion(_drive(MOUNT, count=5), _pose, MOUNT, 265.0)


def _boards(T_camera_lidar, rng, turns=(-0.6, -0.2, 0.3, 0.7)):
    pairs = []
    for turn in turns:
        normal = np.array([np.sin(turn), 0.05, np.cos(turn)])
        normal /= np.linalg.norm(normal)
        centre = np.array([0.1 * turn, 0.0, 0.8])
        along = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        on_board = centre + np.linspace(-0.2, 0.2, 40)[:, None] * along
        beyond = np.column_stack([np.linspace(-2, 2, 60), np.zeros(60), np.full(60, 2.5)])
        points = transform_points(inverse(T_camera_lidar), np.concatenate([on_board, beyond]))
        # Where the lidar's plane cuts the board; height is free.
        points[:, 2] = 0.0
        origin = T_camera_lidar[:3, 3]
        direction = points @ T_camera_lidar[:3, :3].T
        s = (normal @ centre - normal @ origin) / (direction[:40] @ normal)
        points[:40] *= s[:, None]
        points += rng.normal(0, 0.004, points.shape) * [1, 1, 0]
        pairs.append(BoardPair(normal, float(normal @ centre), centre, 0.22, points))
    return pairs


def test_a_board_gives_yaw_and_offsets_from_5_degrees_and_5_centimetres_off():
    truth = (np.radians(-1.3), -0.017, -0.09)
    T = level_mount(truth[0], truth[1], 0.02, truth[2])
    pairs = _boards(T, np.random.default_rng(0))
    for sign in (-1, 1):
        start = (truth[0] + sign * np.radians(5), truth[1] - sign * 0.05, truth[2] + 0.05)
        found = solve_board(pairs, start, 0.02)
        assert np.degrees(found.yaw_rad - truth[0]) == pytest.approx(0.0, abs=0.3)
        assert found.x_m == pytest.approx(truth[1], abs=0.01)
        assert found.z_m == pytest.approx(truth[2], abs=0.01)
        assert found.rms_m < 0.006


def test_boards_that_face_one_way_are_refused():
    T = level_mount(0.0, 0.0, 0.0, -0.1)
    with pytest.raises(ValueError, match="turn the board"):
        solve_board(_boards(T, np.random.default_rng(0), turns=(0.0, 0.0, 0.0)), (0.0, 0.0, -0.1))


def test_a_mirrored_lidar_and_one_turned_round_are_told_from_a_right_one():
    rng = np.random.default_rng(0)
    poses = [se2_to_se3(np.array([0.1 * k, 0.3 * np.sin(0.3 * k), 0.15 * k])) for k in range(24)]
    T_body_lidar = lidar_mount(0.05, 0.0, 0.18)
    scans = [transform_points(inverse(T_body_lidar), scan(T, rng).points_body_m) for T in poses]
    assert check_mounting(scans, poses, T_body_lidar).status == "ok"
    flipped = check_mounting([s * [1, -1, 1] for s in scans], poses, T_body_lidar)
    assert "mirrored" in flipped.status
    turned = check_mounting([s * [-1, -1, 1] for s in scans], poses, T_body_lidar)
    assert "turned round" in turned.status
    assert "hardly moved" in check_mounting(scans[:2], poses[:2], T_body_lidar).status
