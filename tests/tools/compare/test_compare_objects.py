"""Grouping of changed lidar cells and voxels to objects, and the support that a camera alone needs."""

import numpy as np
import pytest

from beamsplat.tools.compare.beams import CELL_M, BeamCounts, BeamEvidence
from beamsplat.tools.compare.objects import VANISHED, find_objects
from beamsplat.tools.compare.pictures import ObjectPair
from beamsplat.tools.compare.voxels import ChangedVoxels

NO_VOXELS = ChangedVoxels(np.zeros((0, 3)), np.zeros(0, bool), np.zeros(0, np.int32), np.zeros(0, np.int32))


def vanished_at(squares, size_m=0.1) -> BeamEvidence:
    """Return evidence of squares (x, y of the lower corner, m) that have vanished, on a floor of 6 x 6 m."""
    cells = np.zeros((120, 120), bool)
    for x, y in squares:
        column, row, n = round(x / CELL_M), round(y / CELL_M), round(size_m / CELL_M)
        cells[row : row + n, column : column + n] = True
    ended = BeamCounts(np.where(cells, 5, 0), np.zeros(cells.shape, int))
    passed = BeamCounts(np.zeros(cells.shape, int), np.full(cells.shape, 8))
    return BeamEvidence(np.zeros(2), ended, passed, cells, np.zeros_like(cells), np.zeros_like(cells))


def voxels_at(points, strong) -> ChangedVoxels:
    points = np.array(points, dtype=np.float64)
    count = np.full(len(points), 4, np.int32)
    return ChangedVoxels(points, np.full(len(points), strong), count, count)


def test_the_legs_of_a_table_are_one_object_and_two_chairs_are_two():
    legs = [(1.0, 1.0), (1.9, 1.0), (1.0, 1.5), (1.9, 1.5)]
    (table,) = find_objects(vanished_at(legs), NO_VOXELS, NO_VOXELS, 0.2)
    assert table.kind == VANISHED
    assert table.centre_m[:2] == pytest.approx([1.5, 1.3], abs=0.06)
    assert (table.cells, table.returns, table.beams) == (16, 80, 128)
    assert table.footprint_m2 == pytest.approx(1.0 * 0.6, rel=0.1)
    chairs = find_objects(vanished_at([(1.0, 1.0), (1.8, 1.0)], 0.4), NO_VOXELS, NO_VOXELS, 0.2)
    assert len(chairs) == 2


def test_single_cells_are_no_object():
    assert find_objects(vanished_at([(1.0, 1.0), (4.0, 4.0)], CELL_M), NO_VOXELS, NO_VOXELS, 0.2) == []


def test_weak_evidence_of_the_camera_counts_only_where_the_lidar_has_seen_the_change():
    x, z = np.meshgrid(np.arange(1.0, 1.4, 0.05), np.arange(0.3, 1.0, 0.05))
    wall = np.column_stack([x.ravel(), np.full(x.size, 1.1), z.ravel()])
    nothing = vanished_at([])
    assert find_objects(nothing, voxels_at(wall, strong=False), NO_VOXELS, 0.2) == []
    (alone,) = find_objects(nothing, voxels_at(wall, strong=True), NO_VOXELS, 0.2)
    assert not alone.by_lidar
    (both,) = find_objects(vanished_at([(1.0, 1.0)], 0.4), voxels_at(wall, strong=False), NO_VOXELS, 0.2)
    assert both.by_lidar
    assert both.high_m[2] == pytest.approx(0.95, abs=0.06)
    assert both.confidence > alone.confidence


def test_two_maps_that_look_the_same_do_not_support_a_change():
    image = np.zeros((2, 2, 3), np.uint8)
    assert ObjectPair(1, image, image, difference=0.11, typical=0.05).looks_changed
    assert not ObjectPair(1, image, image, difference=0.09, typical=0.05).looks_changed


def test_depth_above_a_surface_that_stayed_is_no_evidence_alone():
    """A depth source that extrudes the front of a cupboard upwards makes a wall of the space above it."""
    x, z = np.meshgrid(np.arange(1.0, 1.4, 0.05), np.arange(0.9, 1.5, 0.05))
    above = voxels_at(np.column_stack([x.ravel(), np.full(x.size, 1.1), z.ravel()]), strong=True)
    nothing = vanished_at([])
    assert len(find_objects(nothing, above, above, 0.2)) == 2
    nothing.extruded[:] = True
    assert find_objects(nothing, above, above, 0.2) == []
