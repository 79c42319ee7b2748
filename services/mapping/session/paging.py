"""Keyframes on disk instead of in memory: a budget that holds however long the drive.

Beyond it, keyframes drawn by chance rest: their pose, exposure and optimiser state stay, their pictures are
read again from the session when their turn comes. With each keyframe or tick the one that has rested longest
changes places with another: all are looked at in time, the work is fixed, and nothing thrashes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np

from services.mapping.keyframe import Held, Keyframe, Level, hold
from services.mapping.mapper import FULL, Mapper

log = logging.getLogger("beamsplat.mapping")

_LEAST = 8  # keyframes in memory, whatever the budget: fewer than that teach nothing


def bytes_of(held: Held) -> int:
    """What a keyframe's pictures take."""
    arrays = (getattr(level, field.name) for level in held.levels for field in fields(Level))
    return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))


def resting(held: Held) -> Held:
    """The keyframe without its pictures; its camera stays."""
    empty = np.zeros(0, np.uint8)
    return replace(held, levels=[Level(held.levels[FULL].camera, empty, empty, empty, empty, empty)])


class Pager:
    """Which keyframes are in memory. Draws are seeded: the same drive pages the same keyframes."""

    def __init__(self, budget_bytes: float, seed: int) -> None:
        self.parked: dict[int, Held] = {}  # resting, in order of parking
        self.lost = 0
        self._budget = budget_bytes
        self._random = np.random.default_rng([seed, 1])

    def page(self, mapper: Mapper, body: Callable[[int], Keyframe], on_disk: Callable[[int], bool]) -> None:
        """One exchange if some rest, then room is made. `on_disk` tells what can be read again."""
        if self.parked:
            self._wake(mapper, body, next(iter(self.parked)))
        used = sum(map(bytes_of, mapper.keyframes.values())) + sum(a.nbytes for a in mapper.store.arrays())
        newest = set(mapper.progress()["newest"])
        free = [id for id in mapper.keyframes if id not in newest and on_disk(id)]
        while used > self._budget and free and len(mapper.keyframes) > _LEAST:
            id = free.pop(int(self._random.integers(len(free))))
            held = mapper.keyframes.pop(id)
            used -= bytes_of(held)
            self.parked[id] = resting(held)

    def _wake(self, mapper: Mapper, body: Callable[[int], Keyframe], id: int) -> None:
        rested = self.parked.pop(id)
        try:
            fresh = hold(body(id), mapper.settings.sigma_unit)
        except ValueError as error:
            self.lost += 1
            log.warning("keyframe %d is not looked at any more: %s", id, error)
            return
        mapper.keyframes[id] = replace(rested, levels=fresh.levels)
