"""Evidence of the lidar: cells where scans of one session end, and all beams of the other pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap
from beamsplat.services.localization.lidar2d.occupancy import HIT, MISS, TileSum, outline
from beamsplat.services.localization.lidar2d.pose_graph_data import Submap
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.tools.compare.drive import MappedDrive

CELL_M = LidarSlamSettings().cell_m
# Of all observations of a cell, from where it is a surface: edges and grazed walls are hit by some beams only
# (the ratio at which the lidar map itself refutes a surface), and below which it is free.
SURFACE_RATIO, FREE_RATIO = 0.2, 0.02
# Depth sources extrude the surface that a beam hits upwards, also above its true end: so near to a surface
# that is still there, depth alone is no evidence.
EXTRUDED_M = 0.15
MIN_HITS, MIN_MISSES = 2, 4  # scans; each is counted in up to two submaps


@dataclass(frozen=True)
class BeamCounts:
    """Observations of the cells of a grid by the scans of one session."""

    hits: np.ndarray  # int32 [H, W], scans with a return in the cell
    misses: np.ndarray  # int32 [H, W], scans whose beams crossed it


@dataclass(frozen=True)
class BeamEvidence:
    """What the scans of two sessions say about the same cells; row 0 has the lowest y."""

    origin_m: np.ndarray  # float64 [2], corner of cell (0, 0)
    a: BeamCounts
    b: BeamCounts
    vanished: np.ndarray  # bool [H, W], surface in a, free in b
    appeared: np.ndarray  # bool [H, W], surface in b, free in a
    extruded: np.ndarray  # bool [H, W], within EXTRUDED_M of a surface in a that is still there in b


def compare_beams(a: MappedDrive, b: MappedDrive, sigma_m: float) -> BeamEvidence:
    """Compare the lidar maps of two sessions in the common frame.

    Args:
        sigma_m: standard deviation of the distance between the surfaces of both maps. A surface of the other
            session within two of them, one cell apart at least, is the same surface.
    """
    parts = [_placed(drive) for drive in (a, b)]
    boxes = np.concatenate([outline(grid, pose) for part in parts for grid, pose in part])
    low = np.floor(boxes.min(axis=0) / CELL_M).astype(int)
    columns, rows = (np.ceil(boxes.max(axis=0) / CELL_M).astype(int) - low).tolist()
    count_a, count_b = (_counts(part, low, (rows, columns)) for part in parts)
    radius = 1 + int(np.ceil(2.0 * sigma_m / CELL_M))
    stayed = _surface(count_a) & ndimage.binary_dilation(_surface(count_b), _disc(radius))
    return BeamEvidence(
        origin_m=low * CELL_M,
        a=count_a,
        b=count_b,
        vanished=_gone(count_a, count_b, radius),
        appeared=_gone(count_b, count_a, radius),
        extruded=ndimage.binary_dilation(stayed, _disc(round(EXTRUDED_M / CELL_M))),
    )


def _placed(drive: MappedDrive) -> list[tuple[FrozenMap, np.ndarray]]:
    submaps: Sequence[Submap] = list(drive.slam.pose_graph.submaps.values())
    return [(s.frozen, drive.pose_map_submap[s.id]) for s in submaps if s.frozen is not None]


def _counts(parts: list[tuple[FrozenMap, np.ndarray]], low: np.ndarray, shape: tuple[int, int]) -> BeamCounts:
    hits, misses = (TileSum.empty(int(low[1]), int(low[0]), shape, CELL_M) for _ in range(2))
    for grid, pose in parts:
        hit, missed = grid.counts()
        none = np.zeros_like(hit)
        hits.add(grid, (hit, none), pose)
        misses.add(grid, (none, missed), pose)
    return BeamCounts(hits.score // HIT, misses.score // MISS)


def _gone(before: BeamCounts, after: BeamCounts, radius: int) -> np.ndarray:
    """Return bool [H, W]: cells with a surface before, and free after with no surface within `radius`."""
    seen = after.hits + after.misses
    free = (after.misses >= MIN_MISSES) & (after.hits <= FREE_RATIO * seen)
    known = (after.hits > 0) & (after.hits > FREE_RATIO * seen)
    return _surface(before) & free & ~ndimage.binary_dilation(known, _disc(radius))


def _surface(counts: BeamCounts) -> np.ndarray:
    """Return bool [H, W]: cells with a surface."""
    return (counts.hits >= MIN_HITS) & (counts.hits > SURFACE_RATIO * (counts.hits + counts.misses))


def _disc(radius: int) -> np.ndarray:
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return x * x + y * y <= radius * radius
