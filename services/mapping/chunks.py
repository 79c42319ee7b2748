"""What viewers have of the map: the version and detail of each chunk that was sent, and what is due next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.geometry import inverse
from common.raster.layout import MEAN
from services.mapping.detail import cell_for, coarser
from services.mapping.mapper import Mapper
from services.mapping.store import moved

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
        params = mapper.store.chunk(anchor)
        due_m = _cell(params, eye)
        if sent == version and cell_m <= due_m:
            return None
        self._clock += 1
        self._sent[anchor] = (version, due_m, self._clock)
        return Part(version, due_m, _in_anchor(mapper, anchor, params, due_m))

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
        return cell_m > 0.0 and cell_m > _cell(mapper.store.chunk(anchor), eye)


def parts(mapper: Mapper, eye: Eye | None) -> dict[int, Part]:
    """The whole map by anchor, for one who asks."""
    out = {}
    for anchor, version in mapper.store.versions().items():
        params = mapper.store.chunk(anchor)
        cell_m = _cell(params, eye)
        out[anchor] = Part(version, cell_m, _in_anchor(mapper, anchor, params, cell_m))
    return out


def _cell(params: np.ndarray, eye: Eye | None) -> float:
    """By the nearest Gaussian; without an eye all detail is due."""
    if eye is None or params.shape[1] == 0:
        return 0.0
    nearest_m = np.sqrt(np.min(np.sum((params[MEAN : MEAN + 3].T - eye.at_m) ** 2, axis=1)))
    return cell_for(float(nearest_m), eye.focal_px, eye.error_px)


def _in_anchor(mapper: Mapper, anchor: int, params: np.ndarray, cell_m: float) -> np.ndarray:
    return coarser(moved(params, inverse(mapper.T_map_anchor[anchor])), cell_m)
