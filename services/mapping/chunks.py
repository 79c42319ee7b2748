"""Publication of chunks: version and level of detail of published chunks, and which chunk to publish next."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.mapfiles.detail import detail_cell_m, merge_by_cell
from beamsplat.common.mapfiles.store import transform_gaussians
from beamsplat.common.raster.layout import MEAN, SCALE
from beamsplat.services.mapping.mapper import Mapper

_NEVER = (-1, 0.0, -1)  # version, cell and time of a chunk that has not been published


@dataclass(frozen=True)
class ChunkUpdate:
    """A chunk to publish: Gaussians in the anchor frame, merged in cells of edge `cell_m` (0: no merging)."""

    version: int
    cell_m: float
    params: np.ndarray  # float32 [14, N]


@dataclass(frozen=True)
class Viewpoint:
    """The viewpoint of a viewer, from which the level of detail is chosen."""

    at_map_m: np.ndarray  # [3]
    focal_px: float
    error_px: float  # detail below this size in the image may be merged


class ChunkCensus:
    """All chunks of a map at one time: versions, contents and levels of detail from one pass over the store.

    It is valid until the map changes.
    """

    def __init__(self, mapper: Mapper, viewpoint: Viewpoint | None) -> None:
        """`viewpoint` chooses the levels of detail; None for full detail."""
        self._mapper, self._viewpoint = mapper, viewpoint
        self._census = mapper.store.census()
        self.versions = self._census.versions  # by anchor id, ascending

    @cached_property
    def _columns(self) -> dict[int, np.ndarray]:
        return self._census.columns()

    @cached_property
    def _nearest_m(self) -> dict[int, float]:
        """Distance from the viewpoint to the nearest Gaussian in memory, by anchor id."""
        assert self._viewpoint is not None  # without one, nothing is merged
        store, c = self._mapper.store, self._census
        if not c.anchors:
            return {}
        means = store.rows(MEAN, SCALE)
        squared = np.sum((means - self._viewpoint.at_map_m[:, None]) ** 2, axis=0)
        nearest = np.sqrt(np.minimum.reduceat(squared[c.order], c.starts))
        return dict(zip(c.anchors, nearest.tolist()))

    def cell_m(self, anchor: int) -> float:
        """Return the edge (m) of the cells in which Gaussians of an anchor are merged; 0 without a viewpoint.

        It grows with the distance from the viewpoint to the nearest Gaussian of the anchor.
        """
        mapper, viewpoint = self._mapper, self._viewpoint
        if viewpoint is None:
            return 0.0
        nearest_m = self._nearest_m.get(anchor, np.inf)
        if mapper.disk_gaussians is not None:
            disk_m = mapper.disk_gaussians.nearest_m(anchor, mapper.T_map_anchor[anchor], viewpoint.at_map_m)
            nearest_m = min(nearest_m, disk_m)
        if not np.isfinite(nearest_m):
            return 0.0
        return detail_cell_m(float(nearest_m), viewpoint.focal_px, viewpoint.error_px)

    def update(self, anchor: int, cell_m: float) -> ChunkUpdate:
        """Return the chunk of an anchor: all Gaussians in memory and on disk, merged by cell."""
        mapper = self._mapper
        columns = self._columns.get(anchor, np.zeros(0, np.int64))
        parts = [mapper.store.selected(columns), *disk_params(mapper, anchor)]
        params = transform_gaussians(np.concatenate(parts, axis=1), inverse(mapper.T_map_anchor[anchor]))
        return ChunkUpdate(self.versions[anchor], cell_m, merge_by_cell(params, cell_m))


class ChunkFeed:
    """Record of the published chunks, which determines the chunks that are due.

    A chunk is due when it has changed, or when a nearer viewpoint shows more detail than was published. When
    the viewpoint moves away, the chunk is not published again with less detail: this would cost bandwidth.
    Nor is it when its anchor moves: the poses of the anchors are published apart.
    """

    def __init__(self) -> None:
        self._sent: dict[int, tuple[int, float, int]] = {}  # anchor -> version, cell, time (count of updates)
        self._clock = 0

    def take_update(self, census: ChunkCensus, anchor: int) -> ChunkUpdate | None:
        """Return the chunk of an anchor and mark it as published; None if no new detail is visible."""
        version = census.versions.get(anchor)
        sent, cell_m, _ = self._sent.get(anchor, _NEVER)
        if version is None:
            return None
        due_m = census.cell_m(anchor)
        if sent == version and cell_m <= due_m:
            return None
        self._clock += 1
        self._sent[anchor] = (version, due_m, self._clock)
        return census.update(anchor, due_m)

    def oldest_due(self, census: ChunkCensus) -> int | None:
        """Return the anchor of the due chunk that was published longest ago; None if no chunk is due."""
        due = [
            anchor
            for anchor, version in census.versions.items()
            if self._sent.get(anchor, _NEVER)[0] != version or self._lacks_detail(census, anchor)
        ]
        return min(due, key=lambda a: (self._sent.get(a, _NEVER)[2], a)) if due else None

    def _lacks_detail(self, census: ChunkCensus, anchor: int) -> bool:
        cell_m = self._sent.get(anchor, _NEVER)[1]
        return cell_m > 0.0 and cell_m > census.cell_m(anchor)


def chunk_snapshot(mapper: Mapper, viewpoint: Viewpoint | None) -> Iterator[tuple[int, ChunkUpdate]]:
    """Yield anchor id and chunk of the whole map, with the detail visible from `viewpoint` (None: all)."""
    census = ChunkCensus(mapper, viewpoint)
    for anchor in census.versions:
        yield anchor, census.update(anchor, census.cell_m(anchor))


def disk_params(mapper: Mapper, anchor: int, degree: int = 0) -> Iterator[np.ndarray]:
    """Yield the Gaussians of an anchor that are on disk only: arrays float32 [14 + 3 K, N], map frame.

    The rows from 14 on are spherical harmonics of the degree.
    """
    if mapper.disk_gaussians is not None:
        yield from mapper.disk_gaussians.read(anchor, mapper.T_map_anchor[anchor], degree)
