"""Publication of chunks: version and level of detail of published chunks, and which chunk to publish next."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.mapfiles.detail import detail_cell_m, merge_by_cell
from beamsplat.common.mapfiles.store import transform_gaussians
from beamsplat.common.raster.layout import MEAN
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


class ChunkFeed:
    """Record of the published chunks, which determines the chunks that are due.

    A chunk is due when it has changed, or when a nearer viewpoint shows more detail than was published. When
    the viewpoint moves away, the chunk is not published again with less detail: this would cost bandwidth.
    """

    def __init__(self) -> None:
        self._sent: dict[int, tuple[int, float, int]] = {}  # anchor -> version, cell, time (count of updates)
        self._clock = 0

    def take_update(self, mapper: Mapper, anchor: int, viewpoint: Viewpoint | None) -> ChunkUpdate | None:
        """Return the chunk of an anchor and mark it as published; None if no new detail is visible.

        Args:
            viewpoint: chooses the level of detail; None for full detail.
        """
        version = mapper.store.versions().get(anchor)
        sent, cell_m, _ = self._sent.get(anchor, _NEVER)
        if version is None:
            return None
        due_m = _cell_m(mapper, anchor, viewpoint)
        if sent == version and cell_m <= due_m:
            return None
        self._clock += 1
        self._sent[anchor] = (version, due_m, self._clock)
        return ChunkUpdate(version, due_m, _params_anchor(mapper, anchor, due_m))

    def oldest_due(self, mapper: Mapper, viewpoint: Viewpoint | None) -> int | None:
        """Return the anchor of the due chunk that was published longest ago; None if no chunk is due."""
        due = [
            anchor
            for anchor, version in mapper.store.versions().items()
            if self._sent.get(anchor, _NEVER)[0] != version or self._lacks_detail(mapper, anchor, viewpoint)
        ]
        return min(due, key=lambda a: (self._sent.get(a, _NEVER)[2], a)) if due else None

    def _lacks_detail(self, mapper: Mapper, anchor: int, viewpoint: Viewpoint | None) -> bool:
        cell_m = self._sent.get(anchor, _NEVER)[1]
        return cell_m > 0.0 and cell_m > _cell_m(mapper, anchor, viewpoint)


def chunk_snapshot(mapper: Mapper, viewpoint: Viewpoint | None) -> dict[int, ChunkUpdate]:
    """Return the chunks of the whole map by anchor, with the detail visible from `viewpoint` (None: all)."""
    out = {}
    for anchor, version in mapper.store.versions().items():
        cell_m = _cell_m(mapper, anchor, viewpoint)
        out[anchor] = ChunkUpdate(version, cell_m, _params_anchor(mapper, anchor, cell_m))
    return out


def disk_params(mapper: Mapper, anchor: int) -> Iterator[np.ndarray]:
    """Yield the Gaussians of an anchor that are on disk only: arrays float32 [14, N], map frame."""
    if mapper.disk_gaussians is not None:
        yield from mapper.disk_gaussians.read(anchor, mapper.T_map_anchor[anchor])


def _cell_m(mapper: Mapper, anchor: int, viewpoint: Viewpoint | None) -> float:
    """Return the edge (m) of the cells in which Gaussians of an anchor are merged; 0 without a viewpoint.

    It grows with the distance from the viewpoint to the nearest Gaussian of the anchor.
    """
    if viewpoint is None:
        return 0.0
    store, at_m = mapper.store, viewpoint.at_map_m
    means = store.params[MEAN : MEAN + 3, : store.count][:, store.anchor[: store.count] == anchor].T
    nearest_m = np.sqrt(np.min(np.sum((means - at_m) ** 2, axis=1), initial=np.inf))
    if mapper.disk_gaussians is not None:
        disk_m = mapper.disk_gaussians.nearest_m(anchor, mapper.T_map_anchor[anchor], at_m)
        nearest_m = min(nearest_m, disk_m)
    if not np.isfinite(nearest_m):
        return 0.0
    return detail_cell_m(float(nearest_m), viewpoint.focal_px, viewpoint.error_px)


def _params_anchor(mapper: Mapper, anchor: int, cell_m: float) -> np.ndarray:
    """Return all Gaussians of an anchor, in memory and on disk, in the anchor's frame, merged by cell."""
    params = np.concatenate([mapper.store.chunk(anchor), *disk_params(mapper, anchor)], axis=1)
    return merge_by_cell(transform_gaussians(params, inverse(mapper.T_map_anchor[anchor])), cell_m)
