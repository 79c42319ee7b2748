"""Occupancy in 3D as an OctoMap binary tree (`.bt`): occupied, free and unknown voxels, map frame, z up.

The tree has 16 levels (Hornung et al. 2013); its leaves are voxels of the map's resolution, or larger cubes
that are free or occupied as a whole.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy import ndimage

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.mapfiles.mesh import TRUNCATION, TsdfVolume
from beamsplat.common.mapfiles.morton import morton_codes
from beamsplat.common.mapfiles.surface import RenderedDepth, points_of

FREE, OCCUPIED = 1, 2  # the format's codes of a child; 0 is unknown, 3 has children
_INNER = 3
_ALL_FREE, _ALL_OCCUPIED = 0x5555, 0xAAAA  # eight children of one kind
_LEVELS = 16
_MIDDLE = 1 << (_LEVELS - 1)  # key of the voxel whose lower corner is the origin
_MARGIN = TRUNCATION + 1.0  # of a TsdfVolume, in voxels
# Largest change of the distance (in voxels) between neighbours that one surface explains: seen at 70 degrees
# from its normal. Between an edge and what is behind it the distance jumps by the truncation distance.
_MAX_STEP = 3.0


def volume_for_octomap(low_m: np.ndarray, high_m: np.ndarray, voxel_m: float) -> TsdfVolume:
    """Return an empty volume around a box whose voxels are voxels of an octree with this resolution.

    Args:
        low_m, high_m: corners of the box in the map frame, [3] each.

    Raises:
        ValueError: too many voxels.
    """
    first = np.floor(low_m / voxel_m) + 0.5  # centres of the octree's voxels are at odd halves
    volume = TsdfVolume.around(first * voxel_m, high_m, voxel_m)
    volume.origin_m = (first - _MARGIN) * voxel_m
    return volume


def occupancy_of(volume: TsdfVolume, views: Iterable[RenderedDepth]) -> tuple[np.ndarray, np.ndarray]:
    """Return the observed voxels of a volume.

    A voxel is occupied if the fused surface crosses the line from its centre to a neighbour's within the
    voxel, and a view shows a point there; free if it is in front of the surface. What is behind the surface
    is unknown.

    Args:
        views: those that were added to `volume`.

    Returns:
        Keys int64 [N, 3] of the octree, and states uint8 [N], `FREE` or `OCCUPIED`.
    """
    seen, distance = volume.weight > 0.0, volume.distance
    states = np.where(seen & (distance > 0.0), np.uint8(FREE), np.uint8(0))
    shown = _near_points(volume, views)
    for axis in range(3):
        a, b = [slice(None)] * 3, [slice(None)] * 3
        a[axis], b[axis] = slice(None, -1), slice(1, None)
        before, after = tuple(a), tuple(b)
        da, db = distance[before], distance[after]
        crossed = seen[before] & seen[after] & ((da > 0.0) != (db > 0.0))
        crossed &= np.abs(da - db) <= _MAX_STEP / TRUNCATION
        nearer = np.abs(da) <= np.abs(db)
        states[before][crossed & nearer & shown[before]] = OCCUPIED
        states[after][crossed & ~nearer & shown[after]] = OCCUPIED
    first = np.round(volume.origin_m / volume.voxel_m - 0.5).astype(np.int64) + _MIDDLE
    return np.argwhere(states > 0) + first, states[states > 0]


def _near_points(volume: TsdfVolume, views: Iterable[RenderedDepth]) -> np.ndarray:
    """Return a mask bool [X, Y, Z] of the voxels that contain a point of a view, or touch one that does.

    The mean of what one view sees as free and another as hidden changes its sign anywhere behind an object.
    """
    out = np.zeros(volume.distance.shape, bool)
    for view in views:
        cells = np.round((points_of(view)[0] - volume.origin_m) / volume.voxel_m).astype(np.int64)
        cells = cells[np.all((cells >= 0) & (cells < out.shape), axis=1)]
        out[tuple(cells.T)] = True
    return ndimage.binary_dilation(out, np.ones((3, 3, 3), bool))


def write_octomap(path: Path, keys: np.ndarray, states: np.ndarray, resolution_m: float) -> None:
    """Write voxels as an octree, atomically; eight equal children become one cube.

    Args:
        keys: int64 [N, 3], unique; key (32768, 32768, 32768) is the voxel from the origin to +resolution.
        states: uint8 [N], `FREE` or `OCCUPIED`.

    Raises:
        ValueError: there are no voxels, or one is outside the octree.
        OSError: the file cannot be written.
    """
    if len(keys) == 0:
        raise ValueError("no voxel has been observed: there is nothing to be written")
    if keys.min() < 0 or keys.max() >= 2 * _MIDDLE:
        raise ValueError(
            f"the map is larger than the {2 * _MIDDLE * resolution_m:g} m of an octree with voxels of "
            f"{resolution_m:g} m; use larger ones"
        )
    nodes = _nodes(keys, states)
    children = int(np.bitwise_count((nodes | nodes >> 1) & 0x5555).sum())
    head = (
        "# Octomap OcTree binary file\n# (feel free to add / change comments, but leave the first line as "
        f"it is!)\n#\nid OcTree\nsize {1 + children}\nres {resolution_m!r}\ndata\n"
    )
    write_atomically(Path(path), head.encode() + nodes.astype("<u2").tobytes())


def _nodes(keys: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return the inner nodes int64 [M], depth first: two bits for each of the eight children."""
    codes = morton_codes(keys)
    order = np.argsort(codes)
    codes, states = codes[order], states[order].astype(np.int64)
    nodes, firsts, levels = [], [], []
    for level in range(1, _LEVELS + 1):
        parents, starts = np.unique(codes >> 3, return_index=True)
        values = np.bitwise_or.reduceat(states << (2 * (codes & 7)), starts)
        codes = parents
        states = np.full(len(values), _INNER)
        if level < _LEVELS:  # the root is always a node
            states[values == _ALL_FREE], states[values == _ALL_OCCUPIED] = FREE, OCCUPIED
        inner = states == _INNER
        nodes.append(values[inner])
        firsts.append(parents[inner] << (3 * level))  # code of the first voxel below the node
        levels.append(np.full(int(inner.sum()), level))
    # Depth first is the order of the first voxel; a node comes before those below it.
    order = np.lexsort((-np.concatenate(levels), np.concatenate(firsts)))
    return np.concatenate(nodes)[order]
