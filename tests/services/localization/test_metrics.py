import numpy as np
import pytest

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.metrics import (
    interpolate_poses,
    read_relations,
    relation_errors,
    rigid_alignment,
    stamp_ns_of,
    trajectory_errors,
)

NS = 1_000_000_000


def test_relations_of_a_perfect_trajectory_are_zero(rng):
    poses = np.column_stack([rng.normal(size=(20, 2)), rng.uniform(-3, 3, 20)])
    stamps = np.arange(20) * NS
    pairs = rng.integers(0, 20, size=(30, 2))
    relations = se2.between_many(poses[pairs[:, 0]], poses[pairs[:, 1]])
    errors = relation_errors(stamps, poses, stamps[pairs], relations)
    assert errors.relations == 30
    assert errors.skipped == 0
    assert errors.translation_mean_m < 1e-12
    assert errors.rotation_mean_deg < 1e-9


def test_relations_by_hand():
    stamps = np.array([0, 1, 2]) * NS
    poses = np.array([[0, 0, 0], [1, 0, np.pi / 2], [1, 2, np.pi / 2]], dtype=float)
    # True relations: (1, 0, 90 deg), (2, 0, 0). Given ones differ by 3-4-5 cm and by 2 degrees.
    given = np.array([[1.03, 0.04, np.pi / 2], [2.0, 0.0, np.radians(2.0)]])
    errors = relation_errors(stamps, poses, np.array([[0, 1], [1, 2]]) * NS, given)
    assert errors.translation_mean_m == pytest.approx((0.05 + 0.0) / 2)
    assert errors.translation_std_m == pytest.approx(0.025)
    assert errors.rotation_mean_deg == pytest.approx(1.0)
    assert errors.rotation_std_deg == pytest.approx(1.0)


def test_relations_in_another_frame_and_without_stamps():
    stamps = np.array([0, 1]) * NS
    poses = np.array([[0, 0, 0], [0, 0, np.pi]])  # turning on the spot moves the lidar
    relation = np.array([[-0.2, 0.0, np.pi]])
    errors = relation_errors(stamps, poses, np.array([[0, 1]]) * NS, relation, np.array([0.1, 0, 0]))
    assert errors.translation_mean_m < 1e-12
    with pytest.raises(ValueError, match="no relation"):
        relation_errors(stamps, poses, np.array([[5, 9]]) * NS, relation)


def test_read_relations(tmp_path):
    path = tmp_path / "x.relations"
    path.write_text(
        "# t1 t2 x y z roll pitch yaw\n976052905.167303 976052911.885496 -0.05 -0.1 0 0 0 -1.5\n\n"
    )
    stamps, relations = read_relations(path)
    assert stamps.tolist() == [[976052905167303000, 976052911885496000]]
    assert relations.tolist() == [[-0.05, -0.1, -1.5]]
    path.write_text("1.0 2.0 3.0\n")
    with pytest.raises(ValueError, match=r"x.relations:1: 3 columns"):
        read_relations(path)
    assert stamp_ns_of("1.000000001") == 1_000_000_001
    assert stamp_ns_of("7") == 7 * NS


def test_trajectory_errors():
    truth = np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)])
    moved = se2.compose_many(np.array([3.0, -1.0, 0.7]), truth)
    exact = trajectory_errors(moved, truth)
    assert exact.ate_first_pose_rmse_m < 1e-12
    assert exact.yaw_rmse_rad < 1e-12
    # An error of one degree at the first pose affects the first-pose alignment, but not the rigid one.
    tilted = moved.copy()
    tilted[0, 2] += np.radians(1.0)
    errors = trajectory_errors(tilted, truth)
    assert errors.ate_se3_rmse_m < 1e-12
    assert errors.ate_first_pose_rmse_m == pytest.approx(
        2 * np.sin(np.radians(0.5)) * np.sqrt(np.mean(np.arange(5.0) ** 2)), rel=1e-6
    )
    # No scale alignment: a trajectory 10 % too long is wrong.
    assert trajectory_errors(truth * [1.1, 1, 1], truth).ate_se3_rmse_m == pytest.approx(0.1 * np.sqrt(2.0))


def test_rigid_alignment_recovers_any_motion(rng):
    pose = np.array([1.5, -0.3, 2.5])
    points = rng.normal(size=(40, 2))
    assert np.allclose(rigid_alignment(points, se2.transform(pose, points)), pose)


def test_yaw_interpolation_takes_the_shorter_direction():
    poses = np.array([[0, 0, np.pi - 0.1], [1, 2, -np.pi + 0.1]])
    middle = interpolate_poses(np.array([0, 10]), poses, np.array([5]))[0]
    assert np.allclose(middle[:2], [0.5, 1.0])
    assert abs(abs(middle[2]) - np.pi) < 1e-9
