"""Paging: hard budgets for the memory of the mapper, independent of the length of the run and the size of
the map: one for host memory, one for the memory of a GPU that computes the map.

Keyframes that are paged out have their images on disk only. Gaussians are paged out in blocks, those farthest
from the robot first. Invariant: all Gaussians that a keyframe in memory observes are in memory; keyframes
that observe a block being paged out are paged out with it.

With each keyframe and tick, one paged-out keyframe that observes no block on disk is paged in. At regular
intervals a random paged-out keyframe is paged in together with all blocks that it observes (the guest).
Gaussians are paged out from 60 % of the free budget down to 50 %: the hysteresis avoids thrashing and bounds
the work. From a GPU they go to the disk, and the latest ones stay in host memory beside it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import fields, replace
from itertools import islice

import numpy as np

from beamsplat.services.mapping.keyframe import PyramidLevel, RgbdKeyframe, StoredKeyframe, compress
from beamsplat.services.mapping.mapper import Mapper
from beamsplat.services.mapping.session.budgets import PAGE_OUT_ABOVE, PAGE_OUT_TO, PROCESS_MB, MemoryRoom
from beamsplat.services.mapping.session.disk_tier import DiskTier, GaussianGroup, groups_of, spheres_of
from beamsplat.services.mapping.session.frustum import frustum_intersects

log = logging.getLogger("beamsplat.mapping")

_MIN_KEYFRAMES = 8  # in memory, whatever the budget: fewer do not constrain the map
_CACHE_SHARE = 0.25  # of the free budget of host memory, at most, for what was paged out from a GPU
_CACHE_BYTES = 1e9  # the same without a budget of host memory
_MAX_TRIED = 32  # paged-out keyframes tested per call until one can be paged in
_GUEST_EVERY = 16  # calls between two keyframes that are paged in with the blocks they observe
_KEYFRAME_BYTES, _ANCHOR_BYTES, _BLOCK_BYTES, _ID_BYTES = 4700, 1000, 2000, 120  # bookkeeping, measured
_INSERTION_FACTOR = 8  # memory to insert a keyframe, as a multiple of its images


def image_bytes(keyframe: StoredKeyframe) -> int:
    """Return the size of the pyramid levels of a keyframe, in bytes."""
    arrays = (getattr(level, field.name) for level in keyframe.levels for field in fields(PyramidLevel))
    return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))


def without_images(keyframe: StoredKeyframe) -> StoredKeyframe:
    """Return a copy of the keyframe without levels."""
    return replace(keyframe, levels=[])


class Pager:
    """Pages keyframes and Gaussians of a mapper so that its memory use is within the budget.

    It is deterministic: memory use is calculated, not measured, and random choices depend on `seed`. The
    engine of the mapper says what there is of its device's memory, and its budget.
    """

    def __init__(self, budget_bytes: float | None, seed: int, disk_tier: DiskTier) -> None:
        """`budget_bytes` is of host memory; None = no limit."""
        self.lost_count = 0  # keyframes that could not be read again
        self.fault = ""  # why the budget is exceeded; "" if it is not
        self.used_bytes = 0
        self.budget_bytes = budget_bytes
        self._disk_tier = disk_tier
        self._random = np.random.default_rng([seed, 1])
        self._calls = 0
        self._disk_fault = ""
        self._guest: int | None = None  # id of the keyframe paged in last with its blocks
        self._needed = 0  # Gaussians that the newest keyframes observe, at the last paging out
        self._block_spheres: tuple[np.ndarray, np.ndarray, np.ndarray] | None = (
            None  # cache; None = out of date
        )

    # --- visibility ---

    def load_visible(self, mapper: Mapper, keyframe: StoredKeyframe) -> None:
        """Page in all Gaussians that a keyframe observes."""
        numbers = self._visible_blocks(mapper, keyframe)
        if len(numbers):
            self._disk_tier.page_in(mapper.store, numbers.tolist(), mapper.T_map_anchor)
            self._block_spheres = None

    def anchors_moved(self, mapper: Mapper) -> None:
        """Restore the invariant (see the module) after anchors moved: keyframes may observe other blocks."""
        self._block_spheres = None
        newest = set(mapper.newest)
        for keyframe in list(mapper.keyframes.values()):
            if keyframe.id in newest:
                self.load_visible(mapper, keyframe)
            elif len(self._visible_blocks(mapper, keyframe)):
                self._page_out(mapper, keyframe.id)

    def _visible_blocks(self, mapper: Mapper, keyframe: StoredKeyframe) -> np.ndarray:
        """Return the numbers of the blocks on disk that a keyframe observes, int64 [B]."""
        if not self._disk_tier.blocks:
            return np.zeros(0, np.int64)
        if self._block_spheres is None:
            self._block_spheres = self._disk_tier.spheres(mapper.T_map_anchor)
        numbers, centres, radii = self._block_spheres
        return numbers[_visible(mapper, keyframe, centres, radii)]

    # --- paging in ---

    def page(
        self, mapper: Mapper, decode: Callable[[int], RgbdKeyframe], on_disk: Callable[[int], bool]
    ) -> None:
        """Page in one keyframe, if any is paged out; then page out until memory use is within the budget.

        Args:
            decode: reads the keyframe with an id from disk; raises ValueError.
            on_disk: returns whether the keyframe with an id is on disk; others are not paged out.
        """
        self._page_in_one(mapper, decode)
        host, rooms = self._host_room(mapper), self._rooms(mapper)
        self._limit_cache(mapper, host)
        self._page_out_gaussians(mapper, rooms, on_disk)
        if host is not None:
            self._page_out_images(mapper, host, on_disk)
        self.used_bytes = self._used(mapper)
        self._check(mapper)
        mapper.max_in_memory = min(int(room.most / room.each) for room in rooms)
        mapper.store.limit_capacity(max(mapper.max_in_memory, 0))

    def _rooms(self, mapper: Mapper) -> list[MemoryRoom]:
        """Return the memories with a budget: of the host, of the engine's device."""
        rooms = [self._host_room(mapper), _device_room(mapper)]
        return [room for room in rooms if room is not None]

    def _host_room(self, mapper: Mapper) -> MemoryRoom | None:
        if self.budget_bytes is None:
            return None
        free, store = self.budget_bytes - self._fixed(mapper), mapper.store
        images = (_MIN_KEYFRAMES + 1) * image_bytes(mapper.keyframes[mapper.newest[-1]])
        # A checkpoint is written from a copy.
        return MemoryRoom(free, store.bytes_each + store.copied_bytes_each, free - images)

    def _limit_cache(self, mapper: Mapper, host: MemoryRoom | None) -> None:
        limit_bytes = _CACHE_BYTES if host is None else max(_CACHE_SHARE * host.free, 0.0)
        self._disk_tier.cache.limit(0.0 if mapper.engine.device_memory is None else limit_bytes)

    def _page_in_one(self, mapper: Mapper, decode: Callable[[int], RgbdKeyframe]) -> None:
        self._calls += 1
        crowded = any(self._needed * room.each > PAGE_OUT_ABOVE * room.free for room in self._rooms(mapper))
        guest_due = self._calls % _GUEST_EVERY == 0 and not crowded
        if self._disk_tier.blocks and mapper.paged_out and guest_due:
            ids = list(mapper.paged_out)
            self._guest = ids[int(self._random.integers(len(ids)))]
            self.load_visible(mapper, mapper.paged_out[self._guest])
            self._page_in(mapper, decode, self._guest)
            return
        for id in list(islice(mapper.paged_out, _MAX_TRIED)):
            if not len(self._visible_blocks(mapper, mapper.paged_out[id])):
                self._page_in(mapper, decode, id)
                return
            mapper.paged_out[id] = mapper.paged_out.pop(id)  # to the end: it can be paged in as a guest only

    def _page_in(self, mapper: Mapper, decode: Callable[[int], RgbdKeyframe], id: int) -> None:
        stored = mapper.paged_out.pop(id)
        try:
            fresh = compress(decode(id), mapper.settings.sigma_unit)
        except ValueError as error:
            self.lost_count += 1
            mapper.forget(id)
            log.warning("the mapper no longer optimises on keyframe %d: %s", id, error)
            return
        mapper.keyframes[id] = replace(stored, levels=fresh.levels)

    def _page_out(self, mapper: Mapper, id: int) -> None:
        mapper.paged_out[id] = without_images(mapper.keyframes.pop(id))
        mapper.engine.forget(id)

    # --- paging out ---

    def _page_out_gaussians(
        self, mapper: Mapper, rooms: list[MemoryRoom], on_disk: Callable[[int], bool]
    ) -> None:
        """Page out Gaussians above their part of a budget, farthest first, and who observes them."""
        store = mapper.store
        if not any(room.is_full(store.count, self._needed) for room in rooms):
            return
        newest = mapper.newest
        pinned = {*newest, self._guest, *(id for id in mapper.keyframes if not on_disk(id))}
        groups = groups_of(store, mapper.T_map_anchor)
        _, centres, radii = spheres_of(groups, mapper.T_map_anchor)
        needed = np.zeros(len(groups), bool)
        for id, keyframe in mapper.keyframes.items():
            if id in pinned:
                needed |= _visible(mapper, keyframe, centres, radii)
        self._needed = sum(len(group.members) for group, n in zip(groups, needed) if n)
        robot = mapper.T_map_camera(mapper.keyframes[newest[-1]])[:3, 3]
        distance_m = np.where(needed, -1.0, np.linalg.norm(centres - robot, axis=1))
        left, leaving = store.count, []
        for index in np.argsort(-distance_m, kind="stable").tolist():
            if needed[index] or all(left * room.each <= PAGE_OUT_TO * room.free for room in rooms):
                break
            leaving.append(index)
            left -= len(groups[index].members)
        self._write_groups(mapper, [groups[index] for index in leaving])
        chosen = np.array(leaving, np.int64)
        for id in [id for id in mapper.keyframes if id not in pinned]:
            if _visible(mapper, mapper.keyframes[id], centres[chosen], radii[chosen]).any():
                self._page_out(mapper, id)

    def _write_groups(self, mapper: Mapper, groups: list[GaussianGroup]) -> None:
        self._block_spheres, self._disk_fault = None, ""
        try:
            self._disk_tier.page_out(mapper.store, groups, mapper.T_map_anchor)
        except OSError as error:
            self._disk_fault = f"; Gaussians cannot be written to disk: {error.strerror}"

    def _page_out_images(self, mapper: Mapper, host: MemoryRoom, on_disk: Callable[[int], bool]) -> None:
        """Page out random keyframes until the images of the others fit into the budget of host memory."""
        left = host.free - host.each * mapper.store.count - self._disk_tier.cache.held_bytes
        used = sum(map(image_bytes, mapper.keyframes.values()))
        pinned = {*mapper.newest, self._guest}
        idle = [id for id in mapper.keyframes if id not in pinned and on_disk(id)]
        while used > left and idle and len(mapper.keyframes) > _MIN_KEYFRAMES:
            id = idle.pop(int(self._random.integers(len(idle))))
            used -= image_bytes(mapper.keyframes[id])
            self._page_out(mapper, id)

    # --- accounting ---

    def _fixed(self, mapper: Mapper) -> float:
        """Return the memory (bytes) that paging cannot free: process, buffers, one insertion, bookkeeping."""
        newest = mapper.newest
        insertion = _INSERTION_FACTOR * image_bytes(mapper.keyframes[newest[-1]]) if newest else 0
        dropped = mapper.progress()["forgotten"]
        kept = _KEYFRAME_BYTES * (len(mapper.keyframes) + len(mapper.paged_out))
        kept += _ANCHOR_BYTES * len(mapper.T_map_anchor)
        kept += _BLOCK_BYTES * len(self._disk_tier.blocks) + _ID_BYTES * len(dropped)
        return PROCESS_MB * 1e6 + mapper.workspace_bytes + insertion + kept

    def _used(self, mapper: Mapper) -> int:
        store = mapper.store
        gaussians = (store.bytes_each + store.copied_bytes_each) * store.count
        images = sum(map(image_bytes, mapper.keyframes.values()))
        return round(self._fixed(mapper) + gaussians + images) + self._disk_tier.cache.held_bytes

    def _check(self, mapper: Mapper) -> None:
        """Set `fault` if the budget is exceeded, else clear it; log a warning when it changes to a fault."""
        before, self.fault = self.fault, ""
        device, device_budget = mapper.engine.device_memory, mapper.engine.device_budget_bytes
        uses = [("memory_mb", self.used_bytes, self.budget_bytes)]
        uses += [] if device is None else [("gpu_memory_mb", device.used_bytes, device_budget)]
        for option, used_bytes, budget_bytes in uses:
            if budget_bytes is not None and used_bytes > budget_bytes:
                self.fault = (
                    f"what the newest keyframes observe takes {used_bytes / 1e6:.0f} MB, "
                    f"mapping.{option} is {budget_bytes / 1e6:.0f}{self._disk_fault}"
                )
        if self.fault and not before:
            log.warning("the memory budget is exceeded: %s", self.fault)

    def status_text(self, mapper: Mapper) -> str:
        """Return a text for the user: numbers of keyframes and Gaussians in memory, on disk and lost."""
        keyframes, blocks = len(mapper.keyframes) + len(mapper.paged_out), len(self._disk_tier.blocks)
        total = mapper.store.count + self._disk_tier.count
        lost = f", {self.lost_count} keyframes lost" if self.lost_count else ""
        lost += f", {self._disk_tier.lost_count} Gaussians lost" if self._disk_tier.lost_count else ""
        where = f"{blocks} blocks on disk only"
        if len(self._disk_tier.cache):
            where = f"{blocks} blocks on disk, {len(self._disk_tier.cache)} of them also in host memory"
        return (
            f"{self._budgets_text(mapper)}: in memory {len(mapper.keyframes)} of {keyframes} keyframes, "
            f"{mapper.store.count} of {total} Gaussians; {where}{lost}"
        )

    def _budgets_text(self, mapper: Mapper) -> str:
        device, device_budget = mapper.engine.device_memory, mapper.engine.device_budget_bytes
        texts = []
        if self.budget_bytes is not None:
            texts.append(f"{self._used(mapper) / 1e6:.0f} of {self.budget_bytes / 1e6:.0f} MB")
        if device is not None and device_budget is not None:
            texts.append(f"{device.used_bytes / 1e6:.0f} of {device_budget / 1e6:.0f} MB of the GPU")
        return ", ".join(texts)


def _device_room(mapper: Mapper) -> MemoryRoom | None:
    memory, budget_bytes = mapper.engine.device_memory, mapper.engine.device_budget_bytes
    if memory is None or budget_bytes is None:
        return None
    free = budget_bytes - memory.fixed_bytes
    return MemoryRoom(free, memory.bytes_each, free)


def _visible(
    mapper: Mapper, keyframe: StoredKeyframe, centres_map_m: np.ndarray, radii_m: np.ndarray
) -> np.ndarray:
    T_map_camera = mapper.T_map_camera(keyframe)
    return frustum_intersects(keyframe.camera, T_map_camera, keyframe.reach_m, centres_map_m, radii_m)
