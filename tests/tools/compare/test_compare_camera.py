"""Evidence of the camera: a box that vanishes, a box that hides, and depth that is too uncertain to say."""

import numpy as np
import pytest

from beamsplat.tools.compare.voxels import VOXEL_M, changed_voxels, surface_voxels
from tests.tools.compare.drives import views_of_room

BOX = (2.0, -0.25, 0.0, 2.5, 0.25, 0.5)
HIDING = (1.2, -0.6, 0.0, 1.4, 0.6, 1.2)  # in front of it


def vanished(before, after, **options):
    """Return the voxels that vanished by strong evidence, float64 [N, 3]."""
    a, b = views_of_room(before), views_of_room(after, **options)
    found = changed_voxels(surface_voxels(a), a, b, 0.015)
    return found.points_m[found.strong]


def test_a_box_that_is_gone_is_found_at_its_place_and_size():
    points = vanished([BOX], [])
    assert len(points) > 60
    low, high = points.min(axis=0), points.max(axis=0)
    assert low == pytest.approx([2.0, -0.25, 0.0], abs=2.0 * VOXEL_M)  # near the floor, the floor is behind
    assert high[1:] == pytest.approx([0.25, 0.5], abs=1.5 * VOXEL_M)
    assert high[0] < 2.5 + 1.5 * VOXEL_M


def test_a_box_that_is_still_there_and_one_that_is_hidden_are_not_reported():
    assert len(vanished([BOX], [BOX])) == 0
    assert len(vanished([BOX], [BOX, HIDING])) == 0
    assert len(vanished([BOX], [HIDING])) < 10  # seen past its edges only


def test_what_a_vanished_box_has_hidden_did_not_appear():
    a, b = views_of_room([BOX]), views_of_room([])
    assert len(changed_voxels(surface_voxels(b), b, a, 0.015).points_m) == 0


@pytest.mark.parametrize(("sigma_m", "found"), [(0.3, True), (1.2, False)])
def test_a_depth_whose_uncertainty_reaches_the_box_is_no_evidence(sigma_m, found):
    """Behind the upper half of the box's front is the wall, 2 m away."""
    points = vanished([BOX], [], sigma_m=sigma_m)
    upper = (np.abs(points[:, 0] - 2.0) < VOXEL_M) & (points[:, 2] > 0.3)
    assert (upper.sum() > 20) == found
