"""LAS files as laspy reads them: positions to 0.1 mm, colours exact."""

import struct

import numpy as np
import pytest

from beamsplat.common.mapfiles.las import write_las


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(3)
    points = rng.uniform(-80.0, 80.0, (4000, 3))
    points[0] = [-12345.6789, 98765.4321, -0.00004]
    colours = rng.integers(0, 256, (4000, 3)).astype(np.uint8)
    colours[:2] = [[0, 0, 0], [255, 255, 255]]
    return points, colours


def test_las_as_laspy_reads_it(cloud, tmp_path):
    laspy = pytest.importorskip("laspy", reason="needs laspy, a reader of LAS: pip install laspy")
    points, colours = cloud
    write_las(tmp_path / "map.las", *cloud)
    las = laspy.read(tmp_path / "map.las")
    assert (str(las.header.version), las.header.point_format.id) == ("1.2", 2)
    np.testing.assert_allclose(las.xyz, points, atol=0.00006)
    np.testing.assert_allclose(las.header.mins, points.min(axis=0), atol=0.00006)
    np.testing.assert_allclose(las.header.maxs, points.max(axis=0), atol=0.00006)
    rgb = np.stack([las.red, las.green, las.blue], axis=1).astype(int)
    np.testing.assert_array_equal(rgb // 256, colours)  # both ways in which readers return to 8 bits
    np.testing.assert_array_equal(np.round(rgb / 65535.0 * 255.0), colours)
    assert set(np.unique(las.return_number)) == set(np.unique(las.number_of_returns)) == {1}


def test_las_by_the_published_offsets(cloud, tmp_path):
    """Read by hand at the byte offsets of the LAS 1.2 specification."""
    points, _ = cloud
    write_las(tmp_path / "map.las", *cloud)
    blob = (tmp_path / "map.las").read_bytes()
    assert blob[:4] == b"LASF"
    assert (blob[24], blob[25]) == (1, 2)
    size, start = struct.unpack_from("<HI", blob, 94)
    assert (size, start) == (227, 227)
    kind, length, count = struct.unpack_from("<BHI", blob, 104)
    assert (kind, length, count) == (2, 26, len(points))
    assert len(blob) == start + length * count
    scale, offset = struct.unpack_from("<3d", blob, 131), struct.unpack_from("<3d", blob, 155)
    raw = np.frombuffer(blob, np.uint8, offset=start).reshape(count, length)
    xyz = raw[:, :12].copy().view("<i4") * scale + offset
    np.testing.assert_allclose(xyz, points, atol=0.00006)


def test_las_says_what_it_cannot_hold(cloud, tmp_path):
    points, colours = cloud
    with pytest.raises(ValueError, match="300000 m from the origin"):
        write_las(tmp_path / "map.las", points + np.array([300_000.0 - points[:, 0].max(), 0, 0]), colours)
    with pytest.raises(ValueError, match="no points"):
        write_las(tmp_path / "map.las", points[:0], colours[:0])
    assert not list(tmp_path.iterdir())
