"""Rearranged homes: parts of a mesh that move or go, placements in view, and the truth of what changed."""

import json

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.tools.simulator.changes import ObjectChange, Rearrangement, changes_json
from beamsplat.tools.simulator.home import build_home
from beamsplat.tools.simulator.mesh import Material, MeshBuilder
from beamsplat.tools.simulator.settings import SimulationSettings
from beamsplat.tools.simulator.shapes import box


def three_boxes(sizes):
    """Return a builder with three boxes in a row, and the parts of the second and the third one with a lamp."""
    b = MeshBuilder(sizes)
    box(b, (0, 0, 0), (0.4, 0.4, 0.4), Material("noise"))
    first = b.part_from()
    box(b, (2, 0, 0), (0.4, 0.4, 0.4), Material("noise"))
    second = b.part_from(first)
    box(b, (4, 0, 0), (0.4, 0.4, 0.4), Material("plain"))
    b.lamp((4, 0, 1), 0.1, 1.0, np.ones(3))
    return b, second, b.part_from(second)


def test_a_part_is_moved_with_its_lamp_and_the_rest_stays_bit_identical(sizes):
    b, _, third = three_boxes(sizes)
    before = b.build()
    count = len(b.vertices_of(third))
    b.move(third, se2_to_se3(np.array([1.0, 2.0, np.pi / 2])))
    after = b.build()
    assert np.array_equal(after.triangles, before.triangles)
    assert np.array_equal(after.uvs, before.uvs)
    assert np.array_equal(after.vertices_m[:-count], before.vertices_m[:-count])
    low, high = after.vertices_m[-count:].min(axis=0), after.vertices_m[-count:].max(axis=0)
    assert (low + high) / 2 == pytest.approx([1.0, 6.0, 0.2], abs=1e-6)  # (4, 0) turned, then moved
    assert b.lights[0].centre_m == pytest.approx((1.0, 6.0, 1.0))
    assert np.linalg.norm(after.normals, axis=1) == pytest.approx(1.0, abs=1e-5)


def test_a_part_is_removed_with_its_lamp_and_the_rest_stays_bit_identical(sizes):
    b, second, third = three_boxes(sizes)
    before = b.build()
    rest = len(before.vertices_m) - len(b.vertices_of(second)) - len(b.vertices_of(third))
    b.remove(second)
    b.remove(third)
    after = b.build()
    assert len(after.vertices_m) == rest
    assert np.array_equal(after.vertices_m, before.vertices_m[:rest])
    assert np.array_equal(after.triangles, before.triangles[: len(after.triangles)])
    assert b.lights == ()


def test_drives_differ_in_their_seed_and_drive_0_has_that_of_the_home():
    assert SimulationSettings(seed=7).drive_seed == 7
    seeds = {SimulationSettings(seed=s, drive=d).drive_seed for s in range(50) for d in range(50)}
    assert len(seeds) == 2500


def test_the_truth_is_written_as_plain_json():
    changes = (ObjectChange("removed", "stool", (0.0, 0.0, 0.0, 1.0, 1.0, 1.0), None),)
    table = json.loads(json.dumps(changes_json(changes)))
    assert table["changes"] == [
        {"kind": "removed", "name": "stool", "before_m": [0, 0, 0, 1, 1, 1], "after_m": None}
    ]


@pytest.mark.slow
def test_a_home_is_rearranged_as_asked_and_is_otherwise_the_same():
    plain = build_home(7).mesh
    home = build_home(7, Rearrangement(3, 2, 1, seed=4))
    kinds = [change.kind for change in home.changes]
    assert kinds == ["moved"] * 3 + ["removed"] * 2 + ["added"]
    boxes = [np.array(b) for c in home.changes for b in (c.before_m, c.after_m) if b is not None]
    for k, one in enumerate(boxes):
        for other in boxes[:k]:  # far enough apart that a result belongs to one of them
            assert np.maximum(one[:2] - other[3:5], other[:2] - one[3:5]).max() >= 0.3
    elsewhere = [_outside(mesh.vertices_m, boxes) for mesh in (plain, home.mesh)]
    assert np.array_equal(*elsewhere)
    again = build_home(7, Rearrangement(3, 2, 1, seed=4))
    assert np.array_equal(again.mesh.vertices_m, home.mesh.vertices_m)
    with pytest.raises(ValueError, match=r"--moved 20: only \d+ pieces"):
        build_home(7, Rearrangement(moved=20))


def _outside(vertices, boxes):
    inside = np.zeros(len(vertices), bool)
    for b in boxes:
        inside |= np.all((vertices > b[:3] - 1e-4) & (vertices < b[3:] + 1e-4), axis=1)
    return vertices[~inside]
