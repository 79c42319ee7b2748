"""Evidence of the lidar: two drives through a flat in which a box has moved, aligned by their scans."""

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.services.localization.lidar2d import se2
from beamsplat.tools.compare.alignment import align_drives
from beamsplat.tools.compare.beams import CELL_M, compare_beams
from beamsplat.tools.compare.objects import APPEARED, VANISHED, find_objects
from beamsplat.tools.compare.voxels import ChangedVoxels
from tests.tools.compare.drives import NEW, OLD, SIZE_M, drive_of, mapped_flat, pose_in

NO_VOXELS = ChangedVoxels(np.zeros((0, 3)), np.zeros(0, bool), np.zeros(0, np.int32), np.zeros(0, np.int32))


@pytest.fixture(scope="module")
def flats():
    """Two maps with their poses in the world: the second drive starts elsewhere, and the box has moved."""
    return mapped_flat(OLD, 0.0, 25.0, 1), mapped_flat(NEW, 3.0, 22.0, 2)


@pytest.fixture(scope="module")
def aligned(flats):
    (a, _), (b, _) = flats
    return align_drives(a, b)


def test_the_second_map_is_placed_within_two_centimetres(flats, aligned):
    (_, pose_world_a), (_, pose_world_b) = flats
    error = se2.between(pose_in(pose_world_a, pose_world_b), aligned.pose_a_b)
    assert np.hypot(error[0], error[1]) < 0.02
    assert abs(error[2]) < np.radians(0.3)
    assert 0.010 < aligned.sigma_m < 0.030
    assert aligned.inlier_ratio > 0.9


def test_the_box_vanished_here_and_appeared_there_and_nothing_else_changed(flats, aligned):
    (a, pose_world_a), (b, _) = flats
    evidence = compare_beams(drive_of(a, a.anchors()), drive_of(b, aligned.pose_a_submap), aligned.sigma_m)
    objects = find_objects(evidence, NO_VOXELS, NO_VOXELS, 0.18)
    assert sorted(o.kind for o in objects) == [APPEARED, VANISHED]
    for found in objects:
        centre = se2.transform(pose_world_a, found.centre_m[None, :2])[0]
        assert centre == pytest.approx(NEW if found.kind == APPEARED else OLD, abs=SIZE_M / 2 + CELL_M)
        assert found.beams > 10
        assert found.centre_m[2] == pytest.approx(0.18, abs=0.01)


def test_the_same_place_seen_again_has_no_changes(flats):
    (a, _), _ = flats
    again, _ = mapped_flat(OLD, 2.0, 20.0, 3)
    alignment = align_drives(a, again)
    evidence = compare_beams(
        drive_of(a, a.anchors()), drive_of(again, alignment.pose_a_submap), alignment.sigma_m
    )
    assert find_objects(evidence, NO_VOXELS, NO_VOXELS, 0.18) == []


def test_a_place_that_is_given_wrongly_is_refused(flats):
    (a, _), (b, _) = flats
    with pytest.raises(UserError, match="nothing is compared"):
        align_drives(a, b, np.array([3.0, 2.0, 2.0]))
