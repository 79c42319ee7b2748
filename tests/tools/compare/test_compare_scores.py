"""Scores of a comparison: found, partly found, false; and the poses of maps in the world."""

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.tools.evaluation.changes import Detection, _table, places_of, score

TRUTH = places_of([
    {"kind": "moved", "name": "stool", "before_m": [0, 0, 0, 0.4, 0.4, 0.5], "after_m": [3, 0, 0, 3.4, 0.4, 0.5]},
    {"kind": "removed", "name": "plant", "before_m": [0, 3, 0, 0.5, 3.5, 1.0], "after_m": None},
    {"kind": "added", "name": "bench", "before_m": None, "after_m": [3, 3, 0, 4.1, 3.4, 0.5]},
])  # fmt: skip


def seen(kind, x, y, size=0.4, pose_world_map=(0.0, 0.0, 0.0)):
    row = {"kind": kind, "centre_m": [x, y, 0.2], "extent_m": [size, size, 0.4]}
    return Detection.of(row, np.array(pose_world_map))


def test_a_moved_object_needs_both_of_its_places():
    all_of_them = [
        seen("vanished", 0.2, 0.2), seen("appeared", 3.2, 0.2), seen("vanished", 0.3, 3.2),
        seen("appeared", 3.3, 3.2), seen("appeared", 3.9, 3.2),  # two parts of the bench
    ]  # fmt: skip
    figures = score(TRUTH, all_of_them)
    assert (figures["changes"], figures["found"], figures["false"]) == (3, 3, 0)
    assert figures["centre_error_p50_m"] < 0.1
    figures = score(TRUTH, all_of_them[1:])
    assert (figures["found"], figures["found_partly"]) == (2, 1)
    assert figures["missed"] == ["vanished stool"]


def test_what_is_elsewhere_or_of_the_other_kind_is_false():
    figures = score(
        TRUTH, [seen("appeared", 0.2, 0.2), seen("vanished", 2.0, 2.0), seen("vanished", 0.2, 3.2)]
    )
    assert (figures["found"], figures["false"], figures["false_numbers"]) == (1, 2, [1, 2])


def test_detections_are_moved_from_the_map_to_the_world():
    """A map whose origin is at (1, 2), turned to the left by 90 degrees: its x axis is the world's y axis."""
    there = seen("vanished", 1.2, 0.8, 0.2, (1.0, 2.0, np.pi / 2))
    assert there.rectangle.mean(axis=0) == pytest.approx([0.2, 3.2])
    assert score(TRUTH, [there])["found"] == 1


def test_a_file_without_the_field_is_refused_with_its_name(tmp_path):
    (tmp_path / "changes.json").write_text("{}")
    with pytest.raises(UserError, match=r"changes.json: has no field 'objects'"):
        _table(tmp_path / "changes.json", "objects")
    with pytest.raises(UserError, match=r"absent.json: cannot be read"):
        _table(tmp_path / "absent.json", "objects")
