"""The Gaussians of the map, bound to anchors and grouped in chunks by them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.geometry import quat_wxyz_from_matrix
from common.raster.layout import MEAN, OPACITY, QUAT, SCALE
from common.raster.optimiser import GaussianArrays

_LEAP = 1000  # events of one anchor between two checkpoints: never as many


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
        super().__init__(capacity)

    def _allocate(self, capacity: int) -> None:
        super()._allocate(capacity)
        self.anchor = np.zeros(capacity, np.int64)
        self.strikes = np.zeros(capacity, np.int32)  # times seen floating before a trusted surface

    def _arrays(self) -> list[str]:
        return [*super()._arrays(), "anchor", "strikes"]

    def arrays(self) -> list[np.ndarray]:
        """All arrays, with the room to grow."""
        return [getattr(self, name) for name in self._arrays()]

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
        added = self.append(params)  # may replace all arrays by larger ones, so their names are read after it
        self.anchor[added] = anchor
        self._events[anchor] = self._events.get(anchor, 0) + 1

    def keep(self, mask: np.ndarray) -> int:
        """Drops Gaussians whose flag in bool [count] is unset, the rest keep their order; gives how many."""
        for anchor in np.unique(self.anchor[: self.count][~np.asarray(mask)]):
            self._events[int(anchor)] = self._events.get(int(anchor), 0) + 1
        return super().keep(mask)

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
