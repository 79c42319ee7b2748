"""The Gaussians of the map, bound to anchors and grouped in chunks by them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from beamsplat.common.geometry.transforms import quat_wxyz_from_matrix
from beamsplat.common.raster.layout import MEAN, OPACITY, QUAT, SCALE
from beamsplat.common.raster.optimiser import GaussianArrays

_LEAP = 1000  # events of one anchor between two checkpoints: never as many


class Elsewhere(Protocol):
    """Gaussians that are not in memory."""

    def read(self, anchor: int, T_map_anchor: np.ndarray) -> Iterator[np.ndarray]:
        """float32 [14, N] of an anchor's, in the map frame, in parts."""

    def nearest_m(self, anchor: int, T_map_anchor: np.ndarray, at_m: np.ndarray) -> float:
        """No Gaussian of an anchor is nearer to a place in the map; infinite where there is none."""


@dataclass(frozen=True)
class Chunk:
    """The Gaussians of one anchor. `version` changes whenever one of them does."""

    anchor: int
    version: int
    params: np.ndarray  # float32 [14, N], in the map frame


class GaussianStore(GaussianArrays):
    """Gaussians that belong to anchors, and how often each was seen where nothing can be."""

    def __init__(self, capacity: int = 4096) -> None:
        self._events: dict[int, int] = {}  # per anchor: insertions, removals and moves so far
        self.away: dict[int, tuple[int, int]] = {}  # per anchor: (Gaussians, their steps) on disk only
        super().__init__(capacity)

    def _allocate(self, capacity: int) -> None:
        super()._allocate(capacity)
        self.anchor = np.zeros(capacity, np.int64)
        self.strikes = np.zeros(capacity, np.int32)  # times seen floating before a trusted surface

    def _arrays(self) -> list[str]:
        return [*super()._arrays(), "anchor", "strikes"]

    @property
    def bytes_each(self) -> int:
        """What one Gaussian takes in all arrays."""
        return sum(getattr(self, name).nbytes for name in self._arrays()) // self.capacity

    def state(self) -> dict[str, np.ndarray]:
        """Copies of all arrays, cut to the Gaussians there are, and of the events by anchor."""
        out = {name: getattr(self, name)[..., : self.count].copy() for name in self._arrays()}
        out["events"] = np.array(list(self._events.items()), np.int64).reshape(-1, 2)
        return out

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Becomes what `state` came from. Versions leap ahead of all that may have been told since.

        Raises:
            KeyError: an array is missing.
        """
        self.count = state["params"].shape[1]
        self._allocate(-(-max(self.count, 1) // 16) * 16)
        for name in self._arrays():
            getattr(self, name)[..., : self.count] = state[name]
        self._events = {anchor: events + _LEAP for anchor, events in state["events"].tolist()}

    def add(self, params: np.ndarray, anchor: int) -> None:
        """Adds Gaussians float32 [14, M] bound to an anchor."""
        at = self.append(params)  # may bring new arrays: they are asked for afterwards
        self.anchor[at] = anchor
        self._events[anchor] = self._events.get(anchor, 0) + 1

    def keep(self, mask: np.ndarray) -> int:
        """Drops Gaussians whose flag in bool [count] is unset, the rest keep their order; gives how many."""
        for anchor in np.unique(self.anchor[: self.count][~np.asarray(mask)]):
            self._events[int(anchor)] = self._events.get(int(anchor), 0) + 1
        return super().keep(mask)

    @property
    def away_count(self) -> int:
        """Gaussians that are on disk only."""
        return sum(count for count, _ in self.away.values())

    def take_out(self, groups: list[np.ndarray]) -> None:
        """Lets go of Gaussians that are on disk now; each group int [N] is of one anchor. The map is as it
        was: no version changes."""
        stay = np.ones(self.count, bool)
        for group in groups:
            self.note_away(int(self.anchor[group[0]]), len(group), _sum(self.steps[group]))
            stay[group] = False
        super().keep(stay)
        self.resize(self.count + self.count // 4)

    def put_back(self, arrays: dict[str, np.ndarray], anchor: int) -> None:
        """Takes in what `columns` gave before they went."""
        count = arrays["params"].shape[1]
        at = self.append(arrays["params"])
        for name in self._arrays()[1:]:
            getattr(self, name)[..., at] = anchor if name == "anchor" else arrays[name]
        self.note_away(anchor, -count, -_sum(arrays["steps"]))

    def columns(self, group: np.ndarray) -> dict[str, np.ndarray]:
        """Copies of all that is known of some Gaussians int [N], but for their anchor."""
        return {name: getattr(self, name)[..., group] for name in self._arrays() if name != "anchor"}

    def note_away(self, anchor: int, count: int, steps: int) -> None:
        """So many more Gaussians of an anchor, with so many steps in all, are on disk only."""
        before = self.away.pop(anchor, (0, 0))
        if before[0] + count:
            self.away[anchor] = (before[0] + count, before[1] + steps)

    def lose(self, anchor: int, count: int, steps: int) -> None:
        """Gaussians on disk cannot be read any more: the anchor's chunk is another one now."""
        self.note_away(anchor, -count, -steps)
        self._events[anchor] = self._events.get(anchor, 0) + 1

    def move(self, anchor: int, T_new_old: np.ndarray) -> None:
        """Moves the Gaussians of an anchor rigidly: means, rotations, and the momentum of the means."""
        chosen = np.flatnonzero(self.anchor[: self.count] == anchor)
        if len(chosen) == 0 and anchor not in self.away:
            return
        self._events[anchor] = self._events.get(anchor, 0) + 1
        self.params[:, chosen], self.first[:, chosen] = carried(
            self.params[:, chosen], self.first[:, chosen], T_new_old
        )

    def versions(self) -> dict[int, int]:
        """Version of every anchor's chunk: grows with each step of the optimiser and each event."""
        anchors, which = np.unique(self.anchor[: self.count], return_inverse=True)
        steps = np.bincount(which, weights=self.steps[: self.count], minlength=len(anchors))
        taken = {int(anchor): int(n) for anchor, n in zip(anchors, steps)}
        for anchor, (_, n) in self.away.items():
            taken[anchor] = taken.get(anchor, 0) + n
        # An event outweighs the steps that removed Gaussians took with them.
        return {a: (events << 40) + taken.get(a, 0) for a, events in sorted(self._events.items())}

    def chunk(self, anchor: int) -> np.ndarray:
        """float32 [14, N]: a copy of an anchor's Gaussians, in the map frame."""
        return self.params[:, : self.count][:, self.anchor[: self.count] == anchor]

    def chunks(self, known: dict[int, int] | None = None) -> list[Chunk]:
        """Chunks whose version differs from that in `known` (all without it), copied."""
        known = known or {}
        return [
            Chunk(a, version, self.chunk(a))
            for a, version in self.versions().items()
            if known.get(a) != version
        ]


def _sum(steps: np.ndarray) -> int:
    return int(steps.sum(dtype=np.float64))


def moved(params: np.ndarray, T_a_b: np.ndarray) -> np.ndarray:
    """Gaussians float32 [14, N] of frame b in frame a."""
    out = params.copy()
    out[MEAN:SCALE] = T_a_b[:3, :3] @ params[MEAN:SCALE].astype(np.float64) + T_a_b[:3, 3:4]
    out[QUAT:OPACITY] = _turning(T_a_b[:3, :3]) @ params[QUAT:OPACITY]
    return out


def carried(params: np.ndarray, first: np.ndarray, T_a_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gaussians of frame b and their momentum, float32 [14, N] each, in frame a."""
    R, turned = T_a_b[:3, :3], first.copy()
    turned[MEAN:SCALE] = R @ first[MEAN:SCALE]
    turned[QUAT:OPACITY] = _turning(R) @ first[QUAT:OPACITY]
    return moved(params, T_a_b), turned


def _turning(R: np.ndarray) -> np.ndarray:
    """[4, 4] that turns quaternions (w, x, y, z) by R: multiplication from the left."""
    w, x, y, z = quat_wxyz_from_matrix(R)
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
