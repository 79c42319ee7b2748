from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.trajectory import (
    Trajectory,
    _rigid,
    format_tum,
    parse_stamp_s,
    parse_tum,
    read_tum,
    write_tum,
)
from beamsplat.common.geometry.transforms import inverse, is_rigid, make_transform, so3_log


def random_poses(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(count, rng=rng).as_matrix()
    return np.array([make_transform(R, rng.uniform(-50, 50, 3)) for R in rotations]).reshape(-1, 4, 4)


def rotation_error_rad(T_a: np.ndarray, T_b: np.ndarray) -> float:
    return float(np.linalg.norm(so3_log((inverse(T_a) @ T_b)[:3, :3])))


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(0, 2**63 - 1), min_size=0, max_size=20, unique=True),
    st.integers(0, 1000),
)
def test_tum_round_trip_is_exact_in_time_and_a_micrometre_in_space(stamps, seed):
    stamps_ns = np.array(sorted(stamps), dtype=np.int64)
    trajectory = Trajectory(stamps_ns, random_poses(len(stamps), seed))
    again = parse_tum(format_tum(trajectory, "made by a test\ntwo lines"), "text")
    assert np.array_equal(again.stamps_ns, stamps_ns)
    for T_a, T_b in zip(trajectory.T_a_b, again.T_a_b):
        assert np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]) < 1e-6
        assert rotation_error_rad(T_a, T_b) < 1e-8


@settings(max_examples=200, deadline=None)
@given(st.text(alphabet="0123456789.eE+-# \nnaifx,", max_size=200))
def test_arbitrary_text_raises_user_errors_only(text):
    try:
        parse_tum(text, "a file")
    except UserError as error:
        assert "a file" in str(error)  # noqa: PT017


def test_stamps_are_exact_to_the_nanosecond():
    assert parse_stamp_s("1767225600.123456789", "here") == 1767225600123456789
    assert parse_stamp_s("1.7672256e9", "here") == 1767225600 * 10**9
    assert parse_stamp_s("0", "here") == 0


@pytest.mark.parametrize("word", ["-1", "nan", "inf", "1e40", "seven", ""])
def test_invalid_stamps_raise_user_error(word):
    with pytest.raises(UserError, match="here"):
        parse_stamp_s(word, "here")


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("1 2 3", "expected 8 numbers"),
        ("1 0 0 0 0 0 0 0", "not a rotation"),
        ("1 0 0 zero 0 0 0 1", "not a pose"),
        ("1 0 0 inf 0 0 0 1", "not finite"),
        ("2 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1", "same stamp"),
    ],
)
def test_errors_name_file_and_line(tmp_path, line, what):
    file = tmp_path / "poses.txt"
    file.write_text(f"# comment\n{line}\n")
    with pytest.raises(UserError, match=what) as caught:
        read_tum(file)
    assert "poses.txt" in str(caught.value)
    assert "2" in str(caught.value)


def test_missing_file_raises_user_error(tmp_path):
    with pytest.raises(UserError, match=r"nowhere\.txt"):
        read_tum(tmp_path / "nowhere.txt")


def test_interpolation_is_linear_in_translation_and_geodesic_in_rotation():
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    trajectory = Trajectory(
        np.array([10**9, 2 * 10**9]),
        np.array([np.eye(4), make_transform(turn, np.array([2.0, 0.0, 0.0]))]),
    )
    middle = trajectory.at(1_250_000_000)
    assert middle[:3, 3] == pytest.approx([0.5, 0.0, 0.0])
    assert Rotation.from_matrix(middle[:3, :3]).as_euler("zyx", degrees=True)[0] == pytest.approx(22.5)
    assert np.array_equal(trajectory.at(2 * 10**9), trajectory.T_a_b[1])


def test_no_pose_outside_the_covered_time_or_in_gaps():
    trajectory = Trajectory(np.array([0, 100, 1000]), np.array([np.eye(4)] * 3))
    assert trajectory.at(1001) is None
    assert trajectory.at(1001, max_extrapolation_ns=1) is not None
    assert trajectory.at(1002, max_extrapolation_ns=1) is None
    assert trajectory.at(500, max_gap_ns=900) is not None
    assert trajectory.at(500, max_gap_ns=899) is None
    assert Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4))).at(5) is None
    indices, poses = trajectory.resampled([50, 500, 2000], max_gap_ns=100)
    assert indices.tolist() == [0]
    assert poses.shape == (1, 4, 4)


def test_extrapolation_continues_the_last_step():
    T = np.array([np.eye(4)] * 2)
    T[1, 0, 3] = 1.0
    trajectory = Trajectory(np.array([0, 100]), T)
    assert trajectory.at(150, max_extrapolation_ns=50)[0, 3] == pytest.approx(1.5)


def test_invalid_trajectories_raise():
    with pytest.raises(ValueError, match="increase"):
        Trajectory(np.array([2, 1]), np.array([np.eye(4)] * 2))
    with pytest.raises(ValueError, match="rigid"):
        Trajectory(np.array([2]), np.array([2 * np.eye(4)]))
    with pytest.raises(ValueError, match="stamps for"):
        Trajectory(np.array([2]), np.zeros((0, 4, 4)))


def test_vectorised_rigidity_check_matches_is_rigid():
    T = random_poses(20, 3)
    T[1, 0, 0] += 1e-3
    T[2, 3, 0] = 1e-9
    T[3, :3, 0] *= -1
    T[4, 0, 3] = np.nan
    T[5, 0, 0] = np.inf
    assert _rigid(T).tolist() == [is_rigid(matrix) for matrix in T]


def test_ground_truth_of_the_house_dataset_can_be_read(shared_dir):
    trajectory = read_tum(shared_dir / "data/house_a/groundtruth.txt")
    length_m = np.linalg.norm(np.diff(trajectory.T_a_b[:, :3, 3], axis=0), axis=1).sum()
    assert length_m == pytest.approx(30.7, abs=0.1)
    assert (trajectory.stamps_ns[-1] - trajectory.stamps_ns[0]) / 1e9 == pytest.approx(88, abs=0.5)


def test_write_tum_leaves_no_partial_file(tmp_path):
    trajectory = Trajectory(np.array([5, 6]), random_poses(2))
    write_tum(tmp_path / "out.txt", trajectory)
    assert [path.name for path in tmp_path.iterdir()] == ["out.txt"]
    assert len(read_tum(tmp_path / "out.txt")) == 2
