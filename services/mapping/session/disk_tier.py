"""The disk tier of the Gaussians: blocks of Gaussians that are on disk and not in memory.

A block contains the Gaussians of one anchor in one cubic cell of the anchor's frame. Gaussians on disk are
not optimised; they move with their anchor.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.common.harmonics.basis import with_degree
from beamsplat.common.mapfiles.blocks import (
    Arrays,
    Block,
    arrays_of_blocks,
    block_file,
    blocks_of,
    placed,
    read_block,
    write_block,
)
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import MEAN, QUAT, SCALE
from beamsplat.services.mapping.session.block_cache import BlockCache
from beamsplat.services.mapping.session.frustum import frustum_intersects

log = logging.getLogger("beamsplat.mapping")

CELL_M = 2.0  # edge of a block's cell
_EXTENT_SIGMA = 3.4  # standard deviations up to which the rasterizer draws a Gaussian


@dataclass(frozen=True)
class GaussianGroup:
    """Gaussians in memory with the same anchor and cell: they form one block when they are paged out."""

    anchor: int
    members: np.ndarray  # int64 [N] columns of the store, ascending
    centre_anchor_m: np.ndarray  # [3]
    radius_m: float  # of the sphere that contains their rendered extents


class DiskTier:
    """The blocks of one session; implements `DiskGaussians`. Files are written by `page_out` only.

    Of an engine with memory of its own, `cache` keeps the blocks paged out last in host memory too.
    """

    def __init__(self, folder: SessionFolder) -> None:
        self._folder = folder
        self.blocks: dict[int, Block] = {}
        self._unsynced: set[int] = set()
        self._stale: set[int] = set()  # files that the next checkpoint does not need
        self._next = 1
        self.lost_count = 0  # Gaussians in files that could not be read again
        self.cache = BlockCache()

    @property
    def count(self) -> int:
        """Return the number of Gaussians that are on disk only."""
        return sum(block.count for block in self.blocks.values())

    # --- paging ---

    def page_out(
        self, store: GaussianStore, groups: list[GaussianGroup], T_map_anchor: dict[int, np.ndarray]
    ) -> list[Block]:
        """Write groups of Gaussians to disk and free their memory; return the new blocks.

        Raises:
            OSError: the disk is full or broken; groups that were not written stay in memory.
        """
        out, gone = [], []
        try:
            for group in groups:
                arrays, number = store.columns(group.members), self._next
                write_block(self._folder.blocks, number, arrays)
                self.cache.put(number, arrays)
                steps = int(arrays["steps"].sum(dtype=np.float64))
                T = T_map_anchor[group.anchor].copy()
                out.append(Block(number, group.anchor, len(group.members), steps, group.centre_anchor_m,
                                 group.radius_m, T))  # fmt: skip
                gone.append(group.members)
                self._next += 1
        except OSError:
            block_file(self._folder.blocks, self._next).unlink(missing_ok=True)
            raise
        finally:
            self.blocks |= {block.number: block for block in out}
            self._unsynced |= {block.number for block in out}
            if gone:
                store.page_out(gone)
        return out

    def page_in(
        self, store: GaussianStore, numbers: Iterable[int], T_map_anchor: dict[int, np.ndarray]
    ) -> int:
        """Read blocks into memory, moved to the current anchor poses; return the number of Gaussians.

        Gaussians of a file that cannot be read are lost; this is logged and counted in `lost_count`.
        """
        loaded = 0
        for number in numbers:
            block = self.blocks.pop(number)
            self._unsynced.discard(number)
            try:
                arrays = self._arrays(block, T_map_anchor[block.anchor])
            except UserError as error:
                log.warning("%d Gaussians are lost: %s", block.count, error)
                self.lost_count += block.count
                store.discard_paged_out(block.anchor, block.count, block.steps)
            else:
                store.page_in(arrays, block.anchor)
                loaded += block.count
            self.cache.remove(number)
            self._stale.add(number)
        return loaded

    def _arrays(self, block: Block, T_map_anchor: np.ndarray) -> Arrays:
        """Return the arrays of a block at the pose of its anchor, from memory or from its file.

        Raises:
            UserError: the file is missing or altered.
        """
        arrays = self.cache.get(block.number)
        if arrays is None:
            return read_block(self._folder.blocks, block, T_map_anchor)
        return placed(arrays, block, T_map_anchor)

    def read(self, anchor: int, T_map_anchor: np.ndarray, degree: int = 0) -> Iterator[np.ndarray]:
        """See `DiskGaussians.read`; a block that cannot be read is logged and left out."""
        for block in [b for b in self.blocks.values() if b.anchor == anchor]:
            try:
                arrays = self._arrays(block, T_map_anchor)
                none = np.zeros((0, block.count), np.float32)
                yield np.concatenate([arrays["params"], with_degree(arrays.get("harmonics", none), degree)])
            except UserError as error:
                log.warning("%d Gaussians are not shown: %s", block.count, error)

    def read_visible(
        self,
        camera: RasterCamera,
        T_map_camera: np.ndarray,  # float64 [4, 4]
        T_map_anchor: dict[int, np.ndarray],
        max_count: int,
    ) -> tuple[list[np.ndarray], int]:
        """Read at most `max_count` Gaussians on disk that a camera may see, the nearest blocks first.

        They stay on disk. Returns:
            The blocks, float32 [14, N] each, in the map frame, and the number of Gaussians left out: of files
            that cannot be read, and those beyond `max_count`.
        """
        numbers, centres, radii = self.spheres(T_map_anchor)
        seen = np.flatnonzero(frustum_intersects(camera, T_map_camera, np.inf, centres, radii))
        distance_m = np.linalg.norm(centres[seen] - T_map_camera[:3, 3], axis=1)
        parts, total, left_out = [], 0, 0
        for number in numbers[seen[np.argsort(distance_m, kind="stable")]].tolist():
            block = self.blocks[number]
            if total + block.count > max_count:
                left_out += block.count
                continue
            try:
                parts.append(self._arrays(block, T_map_anchor[block.anchor])["params"])
                total += block.count
            except UserError as error:
                log.warning("%d Gaussians are not shown: %s", block.count, error)
                left_out += block.count
        return parts, left_out

    # --- geometry ---

    def nearest_m(self, anchor: int, T_map_anchor: np.ndarray, at_map_m: np.ndarray) -> float:
        """Return a lower bound (m) of the distance from a point to the Gaussians of an anchor on disk.

        `at_map_m` is the point float64 [3]. The result is inf without any Gaussian on disk.
        """
        blocks = [b for b in self.blocks.values() if b.anchor == anchor]
        at_anchor_m = inverse(T_map_anchor)[:3] @ [*at_map_m, 1.0]
        bounds = [float(np.linalg.norm(b.centre_anchor_m - at_anchor_m)) - b.radius_m for b in blocks]
        return max(min(bounds, default=np.inf), 0.0)

    def spheres(self, T_map_anchor: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return bounding spheres of blocks: numbers int64 [B], centres float64 [B, 3], radii float64 [B].

        Centres are in the map frame; all lengths in m.
        """
        return _spheres([(b.number, b) for b in self.blocks.values()], T_map_anchor)

    # --- checkpoints ---

    def arrays(self) -> Arrays:
        """Return the checkpoint arrays that describe the blocks; an empty dict without any block."""
        return arrays_of_blocks(list(self.blocks.values()))

    def restore(self, arrays: Arrays, store: GaussianStore) -> None:
        """Set the blocks to the blocks listed in a checkpoint; all other block files become stale."""
        for block in blocks_of(arrays):
            self.blocks[block.number] = block
            store.count_paged_out(block.anchor, block.count, block.steps)
        self.find_stale_files()

    def find_stale_files(self) -> None:
        """Mark as stale all block files that are not in `blocks`: of a killed process, or paged in."""
        numbers = self._folder.block_numbers()
        self._stale = set(numbers) - self.blocks.keys()
        self._next = 1 + max(numbers, default=0)

    def pending_files(self) -> tuple[list[int], list[int]]:
        """Return the blocks to flush to disk before a checkpoint, and the blocks to remove after it."""
        return sorted(self._unsynced), sorted(self._stale)

    def mark_saved(self, synced: Iterable[int], removed: Iterable[int]) -> None:
        """Record that a checkpoint is on disk; the arguments are the results of `pending_files` for it."""
        self._unsynced.difference_update(synced)
        self._stale.difference_update(removed)


def groups_of(store: GaussianStore, T_map_anchor: dict[int, np.ndarray]) -> list[GaussianGroup]:
    """Group the Gaussians in memory by anchor and cell.

    Gaussians larger than a cell are in no group and stay in memory: they are few, and visible from far away.
    """
    out, extent = [], np.exp(store.rows(SCALE, QUAT).max(axis=0)) * _EXTENT_SIGMA
    means = store.rows(MEAN, SCALE)
    for anchor in np.unique(store.anchor[: store.count]).tolist():
        members = np.flatnonzero((store.anchor[: store.count] == anchor) & (extent < CELL_M))
        if len(members) == 0:
            continue
        points = transform_points(inverse(T_map_anchor[anchor]), means[:, members].T.astype(float))
        cells = np.floor(points / CELL_M).astype(np.int64) + (1 << 20)
        keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
        order = np.argsort(keys, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(keys[order])) + 1):
            low, high = points[part].min(axis=0), points[part].max(axis=0)
            centre = 0.5 * (low + high)
            reach = np.linalg.norm(points[part] - centre, axis=1) + extent[members[part]]
            out.append(GaussianGroup(anchor, members[part], centre, float(reach.max())))
    return out


def spheres_of(
    groups: list[GaussianGroup], T_map_anchor: dict[int, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return bounding spheres of groups: indices int64 [B], centres float64 [B, 3], radii float64 [B].

    Centres are in the map frame; all lengths in m.
    """
    return _spheres(list(enumerate(groups)), T_map_anchor)


def _spheres(
    items: list[tuple[int, Block]] | list[tuple[int, GaussianGroup]], T_map_anchor: dict[int, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    centres = [
        T_map_anchor[x.anchor][:3, :3] @ x.centre_anchor_m + T_map_anchor[x.anchor][:3, 3] for _, x in items
    ]
    radii = np.array([x.radius_m for _, x in items], np.float64)
    return np.array([n for n, _ in items], np.int64), np.array(centres).reshape(-1, 3), radii
