"""Objects that appeared or vanished: changed lidar cells and changed voxels that stand together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull

from beamsplat.tools.compare.beams import CELL_M, BeamEvidence
from beamsplat.tools.compare.voxels import VOXEL_M, ChangedVoxels

APPEARED, VANISHED = "appeared", "vanished"
# Cells and voxels nearer than this to each other are one object. What is no wider than a leg is then linked
# over the larger distance: the legs of a table.
LINK_M, LEG_LINK_M, LEG_M = 0.25, 1.0, 0.20
# The least evidence of an object: lidar cells alone, voxels alone (0.1 m^2 of surface), or both.
MIN_CELLS, MIN_VOXELS = 3, 40
MIN_CELLS_BOTH, MIN_VOXELS_BOTH = 2, 10
_CORE = (2.0, 98.0)  # percentiles of the points that the box of an object contains


@dataclass(frozen=True)
class ChangedObject:
    """An object that appeared or vanished, in the frame of the first map, with the evidence for it."""

    kind: str  # APPEARED or VANISHED
    low_m: np.ndarray  # float64 [3], lower corner of its axis-aligned box
    high_m: np.ndarray  # float64 [3], upper corner
    footprint_m2: float
    cells: int  # lidar cells that changed
    returns: int  # scans of one session that ended in them
    beams: int  # scans of the other session that passed them
    voxels: int  # voxels that changed
    seen: int  # keyframes of one session that saw a surface there, the most of any voxel
    through: int  # keyframes of the other session that looked through, the most of any voxel
    points_m: np.ndarray  # float64 [N, 3], the changed voxels and lidar cells

    @property
    def by_lidar(self) -> bool:
        """Return whether the lidar has seen the change; otherwise only the camera has."""
        return self.cells >= MIN_CELLS_BOTH

    @property
    def centre_m(self) -> np.ndarray:
        """Return the centre of the box, float64 [3]."""
        return (self.low_m + self.high_m) / 2

    @property
    def volume_m3(self) -> float:
        """Return the area of the convex footprint times the height of the box."""
        return self.footprint_m2 * float(self.high_m[2] - self.low_m[2])

    @property
    def confidence(self) -> float:
        """Return 0..1: it grows with the number of changed cells and voxels.

        Two sensors that agree count as independent: the doubts are multiplied.
        """
        return 1.0 - float(np.exp(-self.cells / MIN_CELLS - self.voxels / MIN_VOXELS))

    def as_json(self) -> dict[str, Any]:
        """Return the object as JSON values; lengths in metres, rounded to millimetres."""

        def numbers(values: np.ndarray) -> list[float]:
            return [round(float(v), 3) for v in values]

        return {
            "kind": self.kind,
            "centre_m": numbers(self.centre_m),
            "extent_m": numbers(self.high_m - self.low_m),
            "volume_m3": round(self.volume_m3, 4),
            "confidence": round(self.confidence, 3),
            "evidence": {
                "lidar_cells": self.cells, "lidar_returns": self.returns, "lidar_beams_through": self.beams,
                "voxels": self.voxels, "keyframes_seen": self.seen, "keyframes_through": self.through,
            },
        }  # fmt: skip


def find_objects(
    evidence: BeamEvidence, vanished: ChangedVoxels, appeared: ChangedVoxels, beam_height_m: float
) -> list[ChangedObject]:
    """Return the objects that changed, the surest first.

    Args:
        evidence: of the lidar.
        vanished, appeared: evidence of the camera.
        beam_height_m: height of the plane of the lidar in the map frame.
    """
    e, out = evidence, []
    for kind, cells, ended, passed, voxels in (
        (VANISHED, e.vanished, e.a.hits, e.b.misses, vanished),
        (APPEARED, e.appeared, e.b.hits, e.a.misses, appeared),
    ):
        changes = _Changes(kind, cells.copy(), ended, passed, voxels, e, beam_height_m)
        out += changes.take_objects(LINK_M, least_width_m=LEG_M)
        out += changes.take_objects(LEG_LINK_M, least_width_m=0.0)
    return sorted(out, key=lambda o: -o.confidence)


class _Changes:
    """The changed cells and voxels of one kind that belong to no object yet."""

    def __init__(
        self,
        kind: str,
        cells: np.ndarray,  # bool [H, W], changed by the lidar
        ended: np.ndarray,  # int32 [H, W], scans with a return in the cell, of the session with the surface
        passed: np.ndarray,  # int32 [H, W], scans of the other session whose beams crossed it
        voxels: ChangedVoxels,
        evidence: BeamEvidence,
        beam_height_m: float,
    ) -> None:
        self.kind, self.cells, self.ended, self.passed = kind, cells, ended, passed
        self.voxels, self.origin_m, self.beam_height_m = voxels, evidence.origin_m, beam_height_m
        column, row = np.floor((voxels.points_m[:, :2] - self.origin_m) / CELL_M).astype(int).T
        inside = (row >= 0) & (row < cells.shape[0]) & (column >= 0) & (column < cells.shape[1])
        self.left = np.flatnonzero(inside)  # voxels without an object; beyond the lidar map they are not used
        self.row, self.column = row, column
        self.alone = voxels.strong.copy()  # is evidence without the lidar
        self.alone[self.left] &= ~evidence.extruded[row[self.left], column[self.left]]

    def take_objects(self, link_m: float, least_width_m: float) -> list[ChangedObject]:
        """Return the groups of cells and voxels with enough evidence, and remove them from what is left.

        Groups that are narrower than `least_width_m` in both directions stay.
        """
        where = self.cells.copy()
        strong = self.left[self.alone[self.left]]
        where[self.row[strong], self.column[strong]] = True
        reach = int(np.ceil(link_m / (2 * CELL_M)))
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        near = np.hypot(x, y) <= link_m / (2 * CELL_M)
        labels, count = ndimage.label(ndimage.binary_dilation(where, near), np.ones((3, 3)))
        label_of_voxel = labels[self.row[self.left], self.column[self.left]]
        out, taken = [], np.zeros(len(self.left), bool)
        for label, part in enumerate(ndimage.find_objects(labels, count), 1):
            mine = labels[part] == label
            row, column = (at + s.start for at, s in zip(np.nonzero(mine & self.cells[part]), part))
            chosen = label_of_voxel == label
            voxels = self.left[chosen]
            alone = int(self.alone[voxels].sum())
            both = len(row) >= MIN_CELLS_BOTH and len(voxels) >= MIN_VOXELS_BOTH
            if len(row) >= MIN_CELLS or alone >= MIN_VOXELS or both:
                found = self._object(row, column, voxels)
                if (found.high_m - found.low_m)[:2].max() >= least_width_m:
                    out.append(found)
                    self.cells[row, column] = False
                    taken |= chosen
        self.left = self.left[~taken]
        return out

    def _object(self, row: np.ndarray, column: np.ndarray, voxels: np.ndarray) -> ChangedObject:
        flat = (np.column_stack([column, row]) + 0.5) * CELL_M + self.origin_m
        points = np.concatenate([
            self.voxels.points_m[voxels], np.column_stack([flat, np.full(len(row), self.beam_height_m)])
        ])  # fmt: skip
        low, high = np.percentile(points, _CORE, axis=0)
        return ChangedObject(
            kind=self.kind,
            low_m=low - VOXEL_M / 2,
            high_m=high + VOXEL_M / 2,
            footprint_m2=_footprint_m2(points[:, :2]),
            cells=len(row),
            returns=int(self.ended[row, column].sum()),
            beams=int(self.passed[row, column].sum()),
            voxels=len(voxels),
            seen=int(self.voxels.seen[voxels].max(initial=0)),
            through=int(self.voxels.through[voxels].max(initial=0)),
            points_m=points,
        )


def _footprint_m2(xy_m: np.ndarray) -> float:
    """Return the area of the convex hull of points [N, 2], each of which is a square of one cell."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * CELL_M / 2
    squares = (xy_m[:, None] + corners).reshape(-1, 2)
    return float(ConvexHull(squares).volume)  # of a planar hull, the area
