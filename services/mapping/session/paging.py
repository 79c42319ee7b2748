"""A budget for the mapper's memory that holds however long the drive and however large the map.

Keyframes rest on disk without their pictures; Gaussians go to the shelf in blocks, those farthest from the
robot first. A keyframe that is in memory finds all that it sees in memory: whoever sees a block that leaves
rests. With each keyframe or tick one that has rested long and sees nothing on the shelf changes places with
another; now and then one is drawn whose surroundings come back with it. Between the level at which Gaussians
leave and the one that they sink to lies a sixth of their share: nothing thrashes, and the work is bounded.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import fields, replace
from itertools import islice
from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.services.mapping.keyframe import Held, Keyframe, Level, hold
from beamsplat.services.mapping.mapper import FULL, Mapper
from beamsplat.services.mapping.session.disk_tier import Group, Shelf, groups_of, spheres_of
from beamsplat.services.mapping.session.frustum import sees

log = logging.getLogger("beamsplat.mapping")

# What the process takes beside what is counted here, measured live: 270 MB when it starts, then the caches
# of the bus, keyframes that wait, and what the allocator keeps.
PROCESS_MB = 400.0
_LEAST = 8  # keyframes in memory, whatever the budget: fewer than that teach nothing
_SHARE, _DOWN_TO = 0.6, 0.5  # of what is free, for Gaussians: beyond the first they leave until the second
_SPARE = (
    1.25  # times what the newest keyframes see, before anything leaves: where that is more than the share
)
_COPIES = 2  # of each Gaussian in memory: a checkpoint is written from one of its own
_ASKED = 32  # resting keyframes looked at until one may come back
_GUEST_EVERY = 16  # turns: one whose surroundings are on the shelf is brought back with them
_KEYFRAME, _ANCHOR, _BLOCK, _NAME = 4500, 1000, 2000, 120  # bytes of bookkeeping (measured)
_ROOM = 8  # times a keyframe's pictures: what taking one in needs for a moment


def check_budget(memory_mb: float, session: Path | None) -> None:
    """Raises UserError where a budget cannot be kept whatever the map."""
    if session is None:
        raise UserError("mapping.memory_mb: pages to the session's disk; give mapping.session too")
    if memory_mb <= PROCESS_MB:
        raise UserError(
            f"mapping.memory_mb = {memory_mb:g}: the process itself takes {PROCESS_MB:g} MB; give some "
            f"{PROCESS_MB + 100:g} or more"
        )


def bytes_of(held: Held) -> int:
    """What a keyframe's pictures take."""
    arrays = (getattr(level, field.name) for level in held.levels for field in fields(Level))
    return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))


def resting(held: Held) -> Held:
    """The keyframe without its pictures; its camera stays."""
    empty = np.zeros(0, np.uint8)
    return replace(held, levels=[Level(held.levels[FULL].camera, empty, empty, empty, empty, empty)])


class Pager:
    """What is in memory. Draws are seeded and nothing is measured: the same drive pages the same."""

    def __init__(self, budget_bytes: float, seed: int, shelf: Shelf) -> None:
        self.lost = 0  # keyframes that could not be read again
        self.fault = ""  # why the budget is not kept
        self.used_bytes = 0
        self.budget_bytes = budget_bytes
        self._shelf = shelf
        self._random = np.random.default_rng([seed, 1])
        self._turns = 0
        self._disk_fault = ""
        self._guest: int | None = None
        self._needed_bytes = 0  # of Gaussians, by the newest keyframes when some left
        self._where: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None  # of the blocks, while it holds

    # --- what a keyframe needs ---

    def bring(self, mapper: Mapper, held: Held) -> None:
        """All that a keyframe sees comes into memory."""
        numbers = self._on_shelf(mapper, held)
        if len(numbers):
            self._shelf.take(mapper.store, numbers.tolist(), mapper.T_map_anchor)
            self._where = None

    def moved(self, mapper: Mapper) -> None:
        """Anchors have moved: views may reach blocks now that they did not see before."""
        self._where = None
        newest = set(mapper.newest)
        for held in list(mapper.keyframes.values()):
            if held.id in newest:
                self.bring(mapper, held)
            elif len(self._on_shelf(mapper, held)):
                self._rest(mapper, held.id)

    def _on_shelf(self, mapper: Mapper, held: Held) -> np.ndarray:
        """Numbers of the blocks on the shelf that a keyframe sees."""
        if not self._shelf.blocks:
            return np.zeros(0, np.int64)
        if self._where is None:
            self._where = self._shelf.spheres(mapper.T_map_anchor)
        numbers, centres, radii = self._where
        return numbers[_seen(mapper, held, centres, radii)]

    # --- turns ---

    def page(self, mapper: Mapper, body: Callable[[int], Keyframe], on_disk: Callable[[int], bool]) -> None:
        """One exchange if some rest, then room is made. `on_disk` tells what can be read again."""
        self._turn(mapper, body)
        free = self.budget_bytes - self._fixed(mapper)
        self._store_gaussians(mapper, free, on_disk)
        self._rest_pictures(mapper, free, on_disk)
        self.used_bytes = self._used(mapper)
        self._judge(mapper)
        mapper.most_in_memory = int(self._most(mapper, free) / (_COPIES * mapper.store.bytes_each))

    def _turn(self, mapper: Mapper, body: Callable[[int], Keyframe]) -> None:
        self._turns += 1
        crowded = self._needed_bytes > _SHARE * (self.budget_bytes - self._fixed(mapper))
        if self._shelf.blocks and mapper.resting and self._turns % _GUEST_EVERY == 0 and not crowded:
            ids = list(mapper.resting)
            self._guest = ids[int(self._random.integers(len(ids)))]
            self.bring(mapper, mapper.resting[self._guest])
            self._wake(mapper, body, self._guest)
            return
        for id in list(islice(mapper.resting, _ASKED)):
            if not len(self._on_shelf(mapper, mapper.resting[id])):
                self._wake(mapper, body, id)
                return
            mapper.resting[id] = mapper.resting.pop(id)  # waits for its turn as a guest

    def _wake(self, mapper: Mapper, body: Callable[[int], Keyframe], id: int) -> None:
        rested = mapper.resting.pop(id)
        try:
            fresh = hold(body(id), mapper.settings.sigma_unit)
        except ValueError as error:
            self.lost += 1
            mapper.strike_off(id)
            log.warning("keyframe %d is not looked at any more: %s", id, error)
            return
        mapper.keyframes[id] = replace(rested, levels=fresh.levels)

    def _rest(self, mapper: Mapper, id: int) -> None:
        mapper.resting[id] = resting(mapper.keyframes.pop(id))

    # --- room ---

    def _store_gaussians(self, mapper: Mapper, free: float, on_disk: Callable[[int], bool]) -> None:
        """Gaussians beyond their share leave, the farthest from the robot first, and who sees them rests."""
        store, each = mapper.store, _COPIES * mapper.store.bytes_each
        if store.count * each <= max(
            _SHARE * free, min(_SPARE * self._needed_bytes, self._most(mapper, free))
        ):
            return
        newest = mapper.newest
        tied = {*newest, self._guest, *(id for id in mapper.keyframes if not on_disk(id))}
        groups = groups_of(store, mapper.T_map_anchor)
        _, centres, radii = spheres_of(groups, mapper.T_map_anchor)
        needed = np.zeros(len(groups), bool)
        for id in tied & mapper.keyframes.keys():
            needed |= _seen(mapper, mapper.keyframes[id], centres, radii)
        self._needed_bytes = each * sum(len(group.members) for group, n in zip(groups, needed) if n)
        robot = mapper.T_map_camera(mapper.keyframes[newest[-1]])[:3, 3]
        away_m = np.where(needed, -1.0, np.linalg.norm(centres - robot, axis=1))
        left, leaving = store.count * each, []
        for place in np.argsort(-away_m, kind="stable").tolist():
            if needed[place] or left <= _DOWN_TO * free:
                break
            leaving.append(place)
            left -= len(groups[place].members) * each
        self._leave(mapper, [groups[place] for place in leaving])
        chosen = np.array(leaving, np.int64)
        for id in [id for id in mapper.keyframes if id not in tied]:
            if _seen(mapper, mapper.keyframes[id], centres[chosen], radii[chosen]).any():
                self._rest(mapper, id)

    def _most(self, mapper: Mapper, free: float) -> float:
        """Bytes that Gaussians may take at the expense of pictures: the fewest keyframes have to fit too."""
        newest = mapper.newest
        return free - (_LEAST + 1) * bytes_of(mapper.keyframes[newest[-1]])

    def _leave(self, mapper: Mapper, groups: list[Group]) -> None:
        self._where, self._disk_fault = None, ""
        try:
            self._shelf.put(mapper.store, groups, mapper.T_map_anchor)
        except OSError as error:
            self._disk_fault = f"; Gaussians do not go to the disk: {error.strerror}"

    def _rest_pictures(self, mapper: Mapper, free: float, on_disk: Callable[[int], bool]) -> None:
        """Keyframes drawn by chance rest until the others fit."""
        left = free - _COPIES * mapper.store.bytes_each * mapper.store.count
        used = sum(map(bytes_of, mapper.keyframes.values()))
        tied = {*mapper.newest, self._guest}
        idle = [id for id in mapper.keyframes if id not in tied and on_disk(id)]
        while used > left and idle and len(mapper.keyframes) > _LEAST:
            id = idle.pop(int(self._random.integers(len(idle))))
            used -= bytes_of(mapper.keyframes[id])
            self._rest(mapper, id)

    # --- accounts ---

    def _fixed(self, mapper: Mapper) -> float:
        """Bytes that no paging gives back."""
        newest = mapper.newest
        room = _ROOM * bytes_of(mapper.keyframes[newest[-1]]) if newest else 0
        names = mapper.progress()["forgotten"]
        kept = _KEYFRAME * (len(mapper.keyframes) + len(mapper.resting)) + _ANCHOR * len(mapper.T_map_anchor)
        kept += _BLOCK * len(self._shelf.blocks) + _NAME * len(names)
        return PROCESS_MB * 1e6 + mapper.workspace_bytes + room + kept

    def _used(self, mapper: Mapper) -> int:
        gaussians = _COPIES * mapper.store.bytes_each * mapper.store.count
        pictures = sum(map(bytes_of, mapper.keyframes.values()))
        return round(self._fixed(mapper) + gaussians + pictures)

    def _judge(self, mapper: Mapper) -> None:
        before, self.fault = self.fault, ""
        if self.used_bytes > self.budget_bytes:
            self.fault = (
                f"what the newest keyframes see takes {self.used_bytes / 1e6:.0f} MB, mapping.memory_mb is "
                f"{self.budget_bytes / 1e6:.0f}{self._disk_fault}"
            )
        if self.fault and not before:
            log.warning("the memory's budget is not kept: %s", self.fault)

    def text(self, mapper: Mapper) -> str:
        """What is in memory and what is not."""
        held, blocks = len(mapper.keyframes) + len(mapper.resting), len(self._shelf.blocks)
        total = mapper.store.count + self._shelf.count
        lost = f", {self.lost} keyframes lost" if self.lost else ""
        lost += f", {self._shelf.lost} Gaussians lost" if self._shelf.lost else ""
        return (
            f"{self._used(mapper) / 1e6:.0f} of {self.budget_bytes / 1e6:.0f} MB: in memory "
            f"{len(mapper.keyframes)} of {held} keyframes, {mapper.store.count} of {total} Gaussians; "
            f"{blocks} chunks on disk only{lost}"
        )


def _seen(mapper: Mapper, held: Held, centres_map_m: np.ndarray, radii_m: np.ndarray) -> np.ndarray:
    camera = held.levels[FULL].camera
    return sees(camera, mapper.T_map_camera(held), held.reach_m, centres_map_m, radii_m)
