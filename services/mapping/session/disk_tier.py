"""Gaussians on disk instead of in memory, in blocks: those of one anchor in one cube of its frame. What is on
the shelf is not trained; it moves with its anchor."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.common.mapfiles.blocks import (
    Arrays,
    Block,
    arrays_of_blocks,
    block_file,
    blocks_of,
    read_block,
    write_block,
)
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.layout import MEAN, QUAT, SCALE

log = logging.getLogger("beamsplat.mapping")

CELL_M = 2.0
_REACH = 3.4  # standard deviations that the rasterizer draws


@dataclass(frozen=True)
class Group:
    """Gaussians in memory that would be a block."""

    anchor: int
    members: np.ndarray  # int64 [N] columns of the store, rising
    centre_anchor_m: np.ndarray
    radius_m: float


class Shelf:
    """The blocks of one session. Only `put`, `take` and `settled` touch the disk."""

    def __init__(self, folder: SessionFolder) -> None:
        self._folder = folder
        self.blocks: dict[int, Block] = {}
        self._unsynced: set[int] = set()
        self._stale: set[int] = set()  # files that the next checkpoint does without
        self._next = 1
        self.lost = 0  # Gaussians in files that could not be read again

    @property
    def count(self) -> int:
        """Gaussians on disk only."""
        return sum(block.count for block in self.blocks.values())

    # --- in and out ---

    def put(
        self, store: GaussianStore, groups: list[Group], T_map_anchor: dict[int, np.ndarray]
    ) -> list[Block]:
        """Groups go from memory to the disk; gives their blocks.

        Raises:
            OSError: the disk is full or broken; all that had not been written yet stays in memory.
        """
        out, gone = [], []
        try:
            for group in groups:
                arrays, number = store.columns(group.members), self._next
                write_block(self._folder.blocks, number, arrays)
                steps = int(arrays["steps"].sum(dtype=np.float64))
                place = T_map_anchor[group.anchor].copy()
                out.append(Block(number, group.anchor, len(group.members), steps, group.centre_anchor_m,
                                 group.radius_m, place))  # fmt: skip
                gone.append(group.members)
                self._next += 1
        except OSError:
            block_file(self._folder.blocks, self._next).unlink(missing_ok=True)
            raise
        finally:
            self.blocks |= {block.number: block for block in out}
            self._unsynced |= {block.number for block in out}
            if gone:
                store.take_out(gone)
        return out

    def take(self, store: GaussianStore, numbers: Iterable[int], T_map_anchor: dict[int, np.ndarray]) -> int:
        """Blocks come back into memory, where their anchors are now; gives how many Gaussians."""
        came = 0
        for number in numbers:
            block = self.blocks.pop(number)
            self._unsynced.discard(number)
            try:
                arrays = read_block(self._folder.blocks, block, T_map_anchor[block.anchor])
            except UserError as error:
                log.warning("%d Gaussians are lost: %s", block.count, error)
                self.lost += block.count
                store.lose(block.anchor, block.count, block.steps)
            else:
                store.put_back(arrays, block.anchor)
                came += block.count
            self._stale.add(number)
        return came

    def read(self, anchor: int, T_map_anchor: np.ndarray) -> Iterator[np.ndarray]:
        """float32 [14, N] of each block of an anchor, in the map frame. What cannot be read is left out."""
        for block in [b for b in self.blocks.values() if b.anchor == anchor]:
            try:
                yield read_block(self._folder.blocks, block, T_map_anchor)["params"]
            except UserError as error:
                log.warning("%d Gaussians are not shown: %s", block.count, error)

    # --- where they are ---

    def nearest_m(self, anchor: int, T_map_anchor: np.ndarray, at_m: np.ndarray) -> float:
        """See `Elsewhere`: by the blocks' spheres."""
        blocks = [b for b in self.blocks.values() if b.anchor == anchor]
        at_anchor_m = inverse(T_map_anchor)[:3] @ [*at_m, 1.0]
        away = [float(np.linalg.norm(b.centre_anchor_m - at_anchor_m)) - b.radius_m for b in blocks]
        return max(min(away, default=np.inf), 0.0)

    def spheres(self, T_map_anchor: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(numbers int64 [B], centres float64 [B, 3] in the map frame, radii float64 [B])."""
        return _spheres([(b.number, b) for b in self.blocks.values()], T_map_anchor)

    # --- checkpoints ---

    def arrays(self) -> Arrays:
        """What a checkpoint says of the blocks; empty without any."""
        return arrays_of_blocks(list(self.blocks.values()))

    def restore(self, arrays: Arrays, store: GaussianStore) -> None:
        """Becomes what a checkpoint says. Files that it does not name, and those whose Gaussians have been
        read into it, are not needed after the next one."""
        for block in blocks_of(arrays):
            self.blocks[block.number] = block
            store.note_away(block.anchor, block.count, block.steps)
        self.tidy()

    def tidy(self) -> None:
        """Notes which files on the disk nothing needs: a killed writer's, or those of a whole state."""
        numbers = self._folder.block_numbers()
        self._stale = set(numbers) - self.blocks.keys()
        self._next = 1 + max(numbers, default=0)

    def settled(self) -> tuple[list[int], list[int]]:
        """(files to bring to the disk before a checkpoint that is made now, files to remove after it)."""
        return sorted(self._unsynced), sorted(self._stale)

    def saved(self, synced: Iterable[int], removed: Iterable[int]) -> None:
        """A checkpoint with what `settled` gave is on the disk."""
        self._unsynced.difference_update(synced)
        self._stale.difference_update(removed)


def groups_of(store: GaussianStore, T_map_anchor: dict[int, np.ndarray]) -> list[Group]:
    """All Gaussians in memory by anchor and cube, but for those too large for a cube: they are few, and
    seen from afar."""
    out, large = [], np.exp(store.params[SCALE:QUAT, : store.count].max(axis=0)) * _REACH
    for anchor in np.unique(store.anchor[: store.count]).tolist():
        members = np.flatnonzero((store.anchor[: store.count] == anchor) & (large < CELL_M))
        if len(members) == 0:
            continue
        points = transform_points(
            inverse(T_map_anchor[anchor]), store.params[MEAN:SCALE, members].T.astype(float)
        )
        cells = np.floor(points / CELL_M).astype(np.int64) + (1 << 20)
        keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
        order = np.argsort(keys, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(keys[order])) + 1):
            low, high = points[part].min(axis=0), points[part].max(axis=0)
            centre = 0.5 * (low + high)
            reach = np.linalg.norm(points[part] - centre, axis=1) + large[members[part]]
            out.append(Group(anchor, members[part], centre, float(reach.max())))
    return out


def spheres_of(
    groups: list[Group], T_map_anchor: dict[int, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(places in the list int64 [B], centres float64 [B, 3] in the map frame, radii float64 [B])."""
    return _spheres(list(enumerate(groups)), T_map_anchor)


def _spheres(
    items: list[tuple[int, Block]] | list[tuple[int, Group]], T_map_anchor: dict[int, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    centres = [
        T_map_anchor[x.anchor][:3, :3] @ x.centre_anchor_m + T_map_anchor[x.anchor][:3, 3] for _, x in items
    ]
    radii = np.array([x.radius_m for _, x in items], np.float64)
    return np.array([n for n, _ in items], np.int64), np.array(centres).reshape(-1, 3), radii
