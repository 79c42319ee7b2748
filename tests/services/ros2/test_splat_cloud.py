"""The points of the map: one per cell, of bounded number, of the newest revision and the running mapper."""

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.messages.splat_codec import pack
from beamsplat.services.ros2_out.splat_cloud import SplatCloud


def packed(points_m, opacity_logit=4.0):
    params = np.full((14, len(points_m)), 0.5, np.float32)
    params[:3], params[10] = np.transpose(points_m), opacity_logit
    return pack(params)


@pytest.mark.parametrize("seed", range(3))
def test_the_number_of_points_is_bounded_and_they_stay_within_a_cell_of_the_surface(seed):
    rng = np.random.default_rng(seed)
    cloud = SplatCloud(max_points=500, cell_m=0.05)
    everything = []
    for anchor in range(8):
        T = se2_to_se3(rng.uniform(-5, 5, 3))
        flat = np.column_stack([rng.uniform(0, 4, (2000, 2)), np.zeros(2000)])  # a floor
        cloud.add("a", anchor, 0, (0, T), packed(flat))
        everything.append(flat @ T[:3, :3].T + T[:3, 3])
        points, colours = cloud.points()
        assert len(points) == len(colours) <= 500
    assert len(points) > 100
    assert np.abs(points[:, 2]).max() < 1e-3
    true = np.concatenate(everything)
    nearest = [np.sqrt(((true - p) ** 2).sum(axis=1).min()) for p in points[::20]]
    assert max(nearest) < 1e-3  # points are Gaussians of the map, not means of cells
    # Nothing of the floor is further from a point than the diagonal of two cells.
    gaps = [np.sqrt(((points - p) ** 2).sum(axis=1).min()) for p in true[::200]]
    assert max(gaps) < 2 * np.sqrt(2) * cloud.cell_m


def test_haze_is_left_out_and_the_most_opaque_gaussian_of_a_cell_is_kept():
    cloud = SplatCloud(max_points=100, cell_m=0.1)
    points = np.array([[0.01, 0.01, 0.01], [0.02, 0.02, 0.02], [0.55, 0.05, 0.05]])
    cloud.add("a", 0, 0, (0, np.eye(4)), packed(points, np.array([1.0, 3.0, -0.5])))
    assert cloud.points()[0] == pytest.approx(points[1:2], abs=1e-4)


def test_revisions_and_mapper_processes_replace_what_was_there():
    cloud = SplatCloud(max_points=100, cell_m=0.05)
    one, two = np.array([[1.0, 0.0, 0.0]]), np.array([[2.0, 0.0, 0.0]])
    cloud.add("a", 0, 3, (0, np.eye(4)), packed(one))
    cloud.add("a", 0, 2, (0, np.eye(4)), packed(two))  # late
    assert cloud.points()[0] == pytest.approx(one, abs=1e-4)
    assert not cloud.changed
    cloud.add("a", 0, 3, (1, se2_to_se3(np.array([1.0, 0.0, 0.0]))), packed(one))  # more detail, or moved
    assert cloud.points()[0] == pytest.approx(two, abs=1e-4)
    cloud.add("b", 5, 0, (0, np.eye(4)), packed(one))  # a mapper that was started anew
    assert cloud.changed
    assert cloud.points()[0] == pytest.approx(one, abs=1e-4)
    cloud.add("b", 5, 1, (0, np.eye(4)), packed(np.zeros((0, 3))))  # removed
    assert cloud.points()[0].shape == (0, 3)
    with pytest.raises(ValueError, match="packed Gaussians"):
        cloud.add("b", 6, 0, (0, np.eye(4)), np.zeros(60, np.uint8))


def test_a_snapshot_completes_what_was_received_since_without_replacing_it():
    cloud, snapshot = (SplatCloud(max_points=100, cell_m=0.05) for _ in range(2))
    old, new, other = np.array([[1.0, 0.0, 0.0]]), np.array([[1.5, 0.0, 0.0]]), np.array([[3.0, 0.0, 0.0]])
    cloud.add("a", 0, 7, (0, np.eye(4)), packed(new))
    snapshot.add("", 0, 6, (0, np.eye(4)), packed(old))
    snapshot.add("", 1, 2, (0, np.eye(4)), packed(other))
    cloud.points()
    cloud.complete(snapshot)
    assert cloud.changed
    assert cloud.points()[0] == pytest.approx(np.concatenate([new, other]), abs=1e-4)
    first = SplatCloud(max_points=100, cell_m=0.05)
    first.complete(snapshot)
    first.add("a", 0, 7, (0, np.eye(4)), packed(new))  # the first chunk after a restart begins no other map
    assert first.points()[0] == pytest.approx(np.concatenate([new, other]), abs=1e-4)


def test_submaps_move_with_their_anchors_whatever_arrives_first():
    cloud, one = SplatCloud(max_points=100, cell_m=0.05), np.array([[1.0, 0.0, 0.0]])
    shift = np.array([0.5, 0.0, 0.0])
    moved = se2_to_se3(shift)
    cloud.add("a", 0, 3, (0, np.eye(4)), packed(one))
    cloud.move("a", 2, {0: moved, 1: moved})
    assert cloud.points()[0] == pytest.approx(one + shift, abs=1e-4)
    cloud.add("a", 0, 4, (1, np.eye(4)), packed(one))  # sent before the anchors have moved
    cloud.add("a", 1, 4, (1, np.eye(4)), packed(one))
    assert cloud.points()[0] == pytest.approx(np.repeat(one + shift, 2, axis=0), abs=1e-4)
    cloud.move("a", 1, {0: np.eye(4)})
    assert not cloud.changed
    cloud.add("b", 0, 0, (0, np.eye(4)), packed(one))  # a mapper that was started anew
    assert cloud.points()[0] == pytest.approx(one, abs=1e-4)
