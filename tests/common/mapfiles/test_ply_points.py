"""Points of PLY files: which are read, and that a wrong or damaged file is one sentence."""

import struct
import tracemalloc

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.ply import read_ply_points
from beamsplat.common.mapfiles.surface import write_ply

POINTS = np.arange(12.0).reshape(4, 3)
HEAD = """ply
format binary_little_endian 1.0
element vertex 2
property float x
property double y
property float z
end_header
"""
BODY = struct.pack("<fdffdf", 1, 2, 3, 4, 5, 6)


def written(tmp_path, head, body=BODY):
    path = tmp_path / "points.ply"
    path.write_bytes(head.encode() + body)
    return path


def test_vertices_are_read_whatever_follows(tmp_path):
    assert read_ply_points(written(tmp_path, HEAD)).tolist() == [[1, 2, 3], [4, 5, 6]]
    faces = np.array([[0, 1, 2]])
    write_ply(tmp_path / "mesh.ply", POINTS, np.zeros((4, 3), np.uint8), faces)
    assert np.array_equal(read_ply_points(tmp_path / "mesh.ply"), POINTS)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("vertex 2", "vertex 3", "truncated"), ("vertex 2", "vertex 99999999999999999", "truncated"),
        ("vertex 2", "vertex -1", "wrong line"), ("vertex 2", "vertex \u00b2", "wrong line"),
        ("vertex 2", "vertex " + "9" * 5000, "wrong line"), ("vertex 2", "vertex", "wrong line"),
        ("property float x", "property list uchar int x", "not supported"),
        ("property float x", "property quad x", "not supported"),
        ("property float x", "property float w", "expected a binary"),
        ("property float x\n", "property float x\nproperty float x\n", "x"),
        ("element vertex", "element face 3\nelement vertex", "first elements are face"),
        ("binary_little_endian", "ascii", "binary little-endian"), ("end_header", "end", "expected a binary"),
        ("end_header", "comment x\n" * 10_000 + "end_header", "expected a binary"),
    ],
)  # fmt: skip
def test_other_files_are_refused(tmp_path, old, new, said):
    path = written(tmp_path, HEAD.replace(old, new))
    with pytest.raises(UserError, match=said) as caught:
        read_ply_points(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(UserError, match="No such file"):
        read_ply_points(tmp_path / "no.ply")


def test_only_the_points_are_in_memory(tmp_path):
    """51 MB with many other properties."""
    count = 200_000
    head = HEAD.replace("vertex 2", f"vertex {count}").replace(
        "end_header", "".join(f"property double extra{i}\n" for i in range(30)) + "end_header"
    )
    path = written(tmp_path, head, bytes(count * 256))
    tracemalloc.start()
    points = read_ply_points(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert points.shape == (count, 3)
    assert peak < points.nbytes + 40e6 < path.stat().st_size + 10e6
