"""The Gaussians and what the optimiser knows of them, in arrays that grow; bound to anchors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.geometry import quat_wxyz_from_matrix
from common.raster.layout import MEAN, OPACITY, PARAMS, QUAT, SCALE


@dataclass(frozen=True)
class Chunk:
    """The Gaussians of one anchor. `version` changes whenever one of them does."""

    anchor: int
    version: int
    params: np.ndarray  # float32 [14, N], in the map frame


class GaussianStore:
    """Columns 0 ... count of every array are Gaussians; rows of `params` as in common.raster.layout."""

    def __init__(self, capacity: int = 4096) -> None:
        self.count = 0
        self._events: dict[int, int] = {}  # per anchor: insertions, removals and moves so far
        self._allocate(-(-capacity // 16) * 16)

    def _allocate(self, capacity: int) -> None:
        self.params = np.zeros((PARAMS, capacity), np.float32)
        self.first = np.zeros((PARAMS, capacity), np.float32)  # Adam's moments
        self.second = np.zeros((PARAMS, capacity), np.float32)
        self.steps = np.zeros(capacity, np.float32)
        self.anchor = np.zeros(capacity, np.int64)
        self.strikes = np.zeros(capacity, np.int32)  # times seen floating before a trusted surface

    def _arrays(self) -> list[str]:
        return ["params", "first", "second", "steps", "anchor", "strikes"]

    @property
    def capacity(self) -> int:
        return self.params.shape[1]

    def append(self, params: np.ndarray, anchor: int) -> None:
        """Adds Gaussians float32 [14, M] bound to an anchor."""
        new = params.shape[1]
        if self.count + new > self.capacity:
            self._grow(max(self.count + new, 2 * self.capacity))
        at = slice(self.count, self.count + new)
        self.params[:, at] = params
        for name in ("first", "second", "steps", "strikes"):
            getattr(self, name)[..., at] = 0
        self.anchor[at] = anchor
        self._events[anchor] = self._events.get(anchor, 0) + 1
        self.count += new

    def _grow(self, capacity: int) -> None:
        old = {name: getattr(self, name) for name in self._arrays()}
        self._allocate(-(-capacity // 16) * 16)
        for name, array in old.items():
            getattr(self, name)[..., : array.shape[-1]] = array

    def keep(self, mask: np.ndarray) -> int:
        """Drops Gaussians whose flag in bool [count] is unset, the rest keep their order; gives how many."""
        chosen = np.flatnonzero(mask)
        dropped = self.count - len(chosen)
        if dropped:
            for anchor in np.unique(self.anchor[: self.count][~np.asarray(mask)]):
                self._events[int(anchor)] = self._events.get(int(anchor), 0) + 1
            for name in self._arrays():
                array = getattr(self, name)
                array[..., : len(chosen)] = array[..., chosen]
            self.count = len(chosen)
        return dropped

    def move(self, anchor: int, T_new_old: np.ndarray) -> None:
        """Moves the Gaussians of an anchor rigidly: means, rotations, and the momentum of the means."""
        chosen = np.flatnonzero(self.anchor[: self.count] == anchor)
        if len(chosen) == 0:
            return
        self._events[anchor] = self._events.get(anchor, 0) + 1
        self.params[:, chosen] = moved(self.params[:, chosen], T_new_old)
        R = T_new_old[:3, :3]
        self.first[MEAN:SCALE, chosen] = R @ self.first[MEAN:SCALE, chosen]
        self.first[QUAT:OPACITY, chosen] = _turning(R) @ self.first[QUAT:OPACITY, chosen]

    def versions(self) -> dict[int, int]:
        """Version of every anchor's chunk: grows with each step of the optimiser and each event."""
        anchors, which = np.unique(self.anchor[: self.count], return_inverse=True)
        steps = np.bincount(which, weights=self.steps[: self.count], minlength=len(anchors))
        taken = {int(anchor): int(n) for anchor, n in zip(anchors, steps)}
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


def moved(params: np.ndarray, T_a_b: np.ndarray) -> np.ndarray:
    """Gaussians float32 [14, N] of frame b in frame a."""
    out = params.copy()
    out[MEAN:SCALE] = T_a_b[:3, :3] @ params[MEAN:SCALE].astype(np.float64) + T_a_b[:3, 3:4]
    out[QUAT:OPACITY] = _turning(T_a_b[:3, :3]) @ params[QUAT:OPACITY]
    return out


def _turning(R: np.ndarray) -> np.ndarray:
    """[4, 4] that turns quaternions (w, x, y, z) by R: multiplication from the left."""
    w, x, y, z = quat_wxyz_from_matrix(R)
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
