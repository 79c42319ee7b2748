"""LAS and E57 files as their libraries read them: positions to 0.1 mm or exact, colours exact."""

import struct
from xml.etree import ElementTree

import numpy as np
import pytest

from beamsplat.common.mapfiles.e57 import write_e57
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


# --- E57 ---


def test_e57_as_libe57_reads_it(cloud, tmp_path):
    pye57 = pytest.importorskip("pye57", reason="needs libE57, a reader of E57: pip install pye57")
    points, colours = cloud
    write_e57(tmp_path / "map.e57", *cloud)
    with pye57.E57(str(tmp_path / "map.e57")) as file:
        assert file.scan_count == 1
        header = file.get_header(0)
        assert header.point_count == len(points)
        scan = file.read_scan(0, colors=True, ignore_missing_fields=True)
    np.testing.assert_array_equal(np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1), points)
    read = np.stack([scan[f"color{name}"] for name in ("Red", "Green", "Blue")], axis=1)
    np.testing.assert_array_equal(read, colours)


def crc32c(data):
    """Bit by bit, as RFC 3720 defines it."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def test_e57_by_the_published_layout(cloud, tmp_path):
    """Header, checksums of the pages, XML, section and packets, read by hand."""
    points, colours = cloud
    write_e57(tmp_path / "map.e57", *cloud)
    blob = (tmp_path / "map.e57").read_bytes()
    signature, major, _, length, xml_at, xml_length, page = struct.unpack_from("<8sIIQQQQ", blob)
    assert (signature, major, length, page) == (b"ASTM-E57", 1, len(blob), 1024)
    assert crc32c(b"123456789") == 0xE3069283  # the check value of the algorithm
    pages = [blob[first : first + 1024] for first in range(0, len(blob), 1024)]
    for one in (pages[0], pages[-1], pages[len(pages) // 2]):
        assert struct.unpack(">I", one[1020:]) == (crc32c(one[:1020]),)
    content = b"".join(one[:1020] for one in pages)

    def logical(physical):
        return physical - physical // 1024 * 4

    root = ElementTree.fromstring(content[logical(xml_at) : logical(xml_at) + xml_length])
    space = "{http://www.astm.org/COMMIT/E57/2010-e57-v1.0}"
    node = root.find(f"{space}data3D/{space}vectorChild/{space}points")
    assert int(node.get("recordCount")) == len(points)
    start = logical(int(node.get("fileOffset")))
    kind, size, data_at, index_at = struct.unpack_from("<B7xQQQ", content, start)
    assert kind == 1
    at, streams = logical(data_at), [b""] * 6
    while at < logical(index_at):
        kind, _, last, count = struct.unpack_from("<BBHH", content, at)
        assert (kind, count, (last + 1) % 4) == (1, 6, 0)
        lengths = struct.unpack_from("<6H", content, at + 6)
        begin = at + 18
        for i, n in enumerate(lengths):
            streams[i] += content[begin : begin + n]
            begin += n
        at += last + 1
    assert (content[at], at + struct.unpack_from("<H", content, at + 2)[0] + 1) == (0, start + size)
    np.testing.assert_array_equal(np.stack([np.frombuffer(s, "<f8") for s in streams[:3]], axis=1), points)
    np.testing.assert_array_equal(np.stack([np.frombuffer(s, "u1") for s in streams[3:]], axis=1), colours)
