"""What viewers have of the map: the version and detail of each chunk that was sent, and what is due next."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.mapfiles.detail import cell_for, coarser
from beamsplat.common.mapfiles.store import moved
from beamsplat.common.raster.layout import MEAN
from beamsplat.services.mapping.mapper import Mapper

_NEVER = (-1, 0.0, -1)


@dataclass(frozen=True)
class Part:
    """A chunk as it is sent: Gaussians float32 [14, N] in the anchor's frame, merged in cells of `cell_m`."""

    version: int
    cell_m: float
    params: np.ndarray


@dataclass(frozen=True)
class Eye:
    """From where detail is judged, in the map."""

    at_m: np.ndarray  # [3]
    focal_px: float
    error_px: float


class ChunkFeed:
    """Each chunk goes out when it has changed, or when its viewer has come so near that more detail shows.

    Who moves away keeps the detail: sending less again would cost what it saves.
    """

    def __init__(self) -> None:
        self._sent: dict[int, tuple[int, float, int]] = {}  # anchor -> version, cell, when (counted)
        self._clock = 0

    def take(self, mapper: Mapper, anchor: int, eye: Eye | None) -> Part | None:
        """An anchor's Gaussians as they are due, and marked as sent; None if there is nothing new to see."""
        version = mapper.store.versions().get(anchor)
        sent, cell_m, _ = self._sent.get(anchor, _NEVER)
        if version is None:
            return None
        due_m = _cell(mapper, anchor, eye)
        if sent == version and cell_m <= due_m:
            return None
        self._clock += 1
        self._sent[anchor] = (version, due_m, self._clock)
        return Part(version, due_m, _in_anchor(mapper, anchor, due_m))

    def longest_due(self, mapper: Mapper, eye: Eye | None) -> int | None:
        """Of the chunks that have changed or lack detail, the one sent longest ago."""
        due = [
            anchor
            for anchor, version in mapper.store.versions().items()
            if self._sent.get(anchor, _NEVER)[0] != version or self._lacks(mapper, anchor, eye)
        ]
        return min(due, key=lambda a: (self._sent.get(a, _NEVER)[2], a)) if due else None

    def _lacks(self, mapper: Mapper, anchor: int, eye: Eye | None) -> bool:
        cell_m = self._sent.get(anchor, _NEVER)[1]
        return cell_m > 0.0 and cell_m > _cell(mapper, anchor, eye)


def parts(mapper: Mapper, eye: Eye | None) -> dict[int, Part]:
    """The whole map by anchor, for one who asks."""
    out = {}
    for anchor, version in mapper.store.versions().items():
        cell_m = _cell(mapper, anchor, eye)
        out[anchor] = Part(version, cell_m, _in_anchor(mapper, anchor, cell_m))
    return out


def on_disk(mapper: Mapper, anchor: int) -> Iterator[np.ndarray]:
    """float32 [14, N] of an anchor's Gaussians that are not in memory, in parts, in the map frame."""
    if mapper.elsewhere is not None:
        yield from mapper.elsewhere.read(anchor, mapper.T_map_anchor[anchor])


def _cell(mapper: Mapper, anchor: int, eye: Eye | None) -> float:
    """By the nearest Gaussian; without an eye all detail is due."""
    if eye is None:
        return 0.0
    store = mapper.store
    means = store.params[MEAN : MEAN + 3, : store.count][:, store.anchor[: store.count] == anchor].T
    nearest_m = np.sqrt(np.min(np.sum((means - eye.at_m) ** 2, axis=1), initial=np.inf))
    if mapper.elsewhere is not None:
        nearest_m = min(nearest_m, mapper.elsewhere.nearest_m(anchor, mapper.T_map_anchor[anchor], eye.at_m))
    return cell_for(float(nearest_m), eye.focal_px, eye.error_px) if np.isfinite(nearest_m) else 0.0


def _in_anchor(mapper: Mapper, anchor: int, cell_m: float) -> np.ndarray:
    """All of an anchor's Gaussians in its own frame, those on disk too."""
    params = np.concatenate([mapper.store.chunk(anchor), *on_disk(mapper, anchor)], axis=1)
    return coarser(moved(params, inverse(mapper.T_map_anchor[anchor])), cell_m)
