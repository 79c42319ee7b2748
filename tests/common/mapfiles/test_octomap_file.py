"""OctoMap files as the OctoMap library reads them, against a room whose geometry is exact."""

import numpy as np
import pytest

from beamsplat.common.mapfiles.octomap import (
    FREE,
    OCCUPIED,
    occupancy_of,
    volume_for_octomap,
    write_octomap,
)
from beamsplat.common.mapfiles.surface import RenderedDepth
from beamsplat.common.mapfiles.video import look_at
from beamsplat.common.raster.camera import RasterCamera

RESOLUTION_M = 0.1
LOW, HIGH = np.array([-2.03, -1.51, 0.0]), np.array([2.02, 1.54, 2.47])  # corners of the room
BOX = np.array([0.52, -0.33, 0.0]), np.array([1.11, 0.27, 0.74])  # of a cupboard in it
CAMERA = RasterCamera(90.0, 90.0, 79.5, 59.5, 160, 120)


def entry_of_box(origin, rays):
    """Distance factor at which rays [N, 3] enter `BOX`; inf where they miss it."""
    with np.errstate(divide="ignore"):
        a, b = (BOX[0] - origin) / rays, (BOX[1] - origin) / rays
    near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return np.where((near < far) & (far > 0.0), near, np.inf)


def view(eye, target):
    T = look_at(np.array(eye), np.array(target))
    v, u = np.mgrid[:120, :160]
    camera_rays = np.stack([(u - 79.5) / 90.0, (v - 59.5) / 90.0, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    rays, origin = camera_rays @ T[:3, :3].T, T[:3, 3]
    with np.errstate(divide="ignore"):
        walls = np.maximum((LOW - origin) / rays, (HIGH - origin) / rays).min(axis=1)
    depth = np.minimum(walls, entry_of_box(origin, rays)).reshape(120, 160)
    return RenderedDepth(CAMERA, T, np.zeros((120, 160, 3), np.float32), depth.astype(np.float32))


@pytest.fixture(scope="module")
def voxels():
    """Keys and states seen by a camera that turns in three places."""
    volume = volume_for_octomap(LOW, HIGH, RESOLUTION_M)
    turns = np.radians(np.arange(0, 360, 45))
    views = [
        view(eye, [eye[0] + np.cos(t), eye[1] + np.sin(t), 1.1])
        for eye in ([-1.2, 0.0, 1.3], [-0.2, 1.0, 0.9], [1.5, -0.9, 1.6])
        for t in turns
    ]
    volume.add(views)
    return occupancy_of(volume, views)


def centres(keys):
    return (keys - 32768 + 0.5) * RESOLUTION_M


def distance_to_surface(points):
    """Distance (m) of points to the nearest wall or side of the cupboard."""
    wall = np.minimum(np.abs(points - LOW), np.abs(points - HIGH)).min(axis=1)
    outside = np.linalg.norm(np.maximum(np.maximum(BOX[0] - points, points - BOX[1]), 0.0), axis=1)
    inside = np.minimum(points - BOX[0], BOX[1] - points).min(axis=1)
    return np.minimum(wall, np.where(outside > 0.0, outside, inside))


def test_occupied_voxels_contain_the_surface_and_free_ones_are_in_the_room(voxels):
    keys, states = voxels
    occupied, free = centres(keys[states == OCCUPIED]), centres(keys[states == FREE])
    assert len(occupied) > 1500
    # A plane through a voxel is at most half its diagonal (0.087 m) from the centre.
    off_m = distance_to_surface(occupied)
    assert np.mean(off_m < 0.087) > 0.99
    assert off_m.max() < 0.2  # beside an edge, in the shadow of the cupboard
    assert len(free) > 0.6 * np.prod((HIGH - LOW) / RESOLUTION_M)
    within = np.all((free > LOW - 0.05) & (free < HIGH + 0.05), axis=1)
    in_box = np.all((free > BOX[0] + 0.05) & (free < BOX[1] - 0.05), axis=1)
    assert within.all()
    assert not in_box.any()


def test_a_wall_has_no_holes(voxels):
    """Every voxel that the wall at the largest x passes through, from 0.3 m to 2 m height, is occupied."""
    keys, states = voxels
    found = {tuple(key) for key in keys[states == OCCUPIED]}
    x = int(np.floor(HIGH[0] / RESOLUTION_M)) + 32768
    rows = [
        any((x + dx, y + 32768, z + 32768) in found for dx in (-1, 0))
        for y in range(-13, 13)
        for z in range(3, 20)
    ]
    assert np.mean(rows) > 0.99


def test_octomap_reads_the_same_voxels(voxels, tmp_path):
    pyoctomap = pytest.importorskip("pyoctomap", reason="needs the OctoMap library: pip install pyoctomap")
    keys, states = voxels
    write_octomap(tmp_path / "map.bt", keys, states, RESOLUTION_M)
    tree = pyoctomap.OcTree(1.0)
    assert tree.readBinary(str(tmp_path / "map.bt"))
    assert tree.getResolution() == pytest.approx(RESOLUTION_M)
    read = {}
    for leaf in tree.begin_leafs():
        # A cube of several voxels: all of them are alike.
        wide, occupied = round(leaf.getSize() / RESOLUTION_M), tree.isNodeOccupied(leaf)
        corner = np.array(leaf.getCoordinate()) - 0.5 * leaf.getSize()
        first = np.round(corner / RESOLUTION_M).astype(int) + 32768
        for offset in np.ndindex(wide, wide, wide):
            read[tuple((first + offset).tolist())] = OCCUPIED if occupied else FREE
    assert read == {tuple(key): int(state) for key, state in zip(keys.tolist(), states)}
    for key, state in list(zip(keys, states))[::500]:
        assert tree.isNodeOccupied(tree.search(centres(key).tolist())) == (state == OCCUPIED)


def test_equal_neighbours_become_one_cube(tmp_path):
    """A free cube of 8 voxels' edge is one leaf: root, 13 levels of one node each."""
    keys = np.array(list(np.ndindex(8, 8, 8))) + 32768
    write_octomap(tmp_path / "map.bt", keys, np.full(512, FREE, np.uint8), 0.05)
    head, _, body = (tmp_path / "map.bt").read_bytes().partition(b"\ndata\n")
    assert b"size 14" in head
    assert len(body) == 2 * 13


def test_octomap_says_what_it_cannot_hold(tmp_path):
    with pytest.raises(ValueError, match=r"larger than the 655\.36 m"):
        write_octomap(tmp_path / "m.bt", np.array([[65536, 0, 0]]), np.array([FREE], np.uint8), 0.01)
    with pytest.raises(ValueError, match="no voxel"):
        write_octomap(tmp_path / "m.bt", np.zeros((0, 3), int), np.zeros(0, np.uint8), 0.01)
    assert not list(tmp_path.iterdir())
