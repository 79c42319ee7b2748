"""The Gaussians of a map for viewers in browsers: packed, at several levels of detail, in bounded memory.

Chunks arrive packed (`splat_codec`) and are handed out as the same bytes. Coarser levels are made from them
by `make_levels`, in a thread of the caller. What does not fit into the budget is kept without its finest
levels.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from beamsplat.common.mapfiles.detail import merge_by_cell
from beamsplat.common.messages.splat_codec import extent_of, pack, unpack

LEVELS_M = (0.04, 0.08, 0.16, 0.32)  # edges of the cells of coarser levels: halves the number each time
_MIN_SAVING = 0.7  # a level is made if it has at most this share of the Gaussians of the next finer one
_FEWEST = 200  # chunks with fewer Gaussians have one level
_LEVELS_EVERY_S = 1.0  # how often the levels of one chunk are made again at most


@dataclass(frozen=True)
class PackedLevel:
    """Gaussians of one chunk, merged in cells of edge `cell_m` (0: all), in the anchor's frame."""

    cell_m: float
    count: int
    packed: bytes


@dataclass
class _Update:
    """A chunk as it was received."""

    source_revision: int
    level: PackedLevel

    @property
    def order(self) -> tuple[int, float]:
        """Return what grows with newer and with finer updates."""
        return self.source_revision, -self.level.cell_m


@dataclass
class _PackedChunk:
    """A published chunk: levels, finest first, that never change under one `revision`."""

    revision: int
    update: _Update
    levels: list[PackedLevel]
    used: int  # number of its newest request or change: the least recently used one loses detail first
    coarsened: bool = False  # its finest level did not fit into the budget

    @property
    def bytes(self) -> int:
        return sum(len(level.packed) for level in self.levels)


@dataclass
class LevelledMap:
    """Chunks of one map by anchor; every method may be called from any thread.

    Args:
        budget_bytes: for the packed Gaussians of all levels.
        producer: identifies map and numbering: with another producer all is new.
    """

    budget_bytes: int
    producer: str = ""
    revision: int = 0  # grows with any change
    left_out: int = 0  # chunks that did not fit at any level
    damaged: int = 0  # chunks that were no packed Gaussians
    _chunks: dict[int, _PackedChunk] = field(default_factory=dict)
    _pending: dict[int, _Update] = field(default_factory=dict)  # whose levels have to be made
    _made_s: dict[int, float] = field(default_factory=dict)
    _poses: dict[int, tuple[int, np.ndarray]] = field(default_factory=dict)  # anchor -> number, T_map_anchor
    _numbers: int = 0
    _maps: int = 0  # counts the calls of `start_over`
    _lock: threading.RLock = field(default_factory=threading.RLock)

    def start_over(self, producer: str) -> None:
        """Remove all chunks: those of another producer follow."""
        with self._lock:
            self.producer = producer
            self._chunks.clear()
            self._pending.clear()
            self._made_s.clear()
            self._poses.clear()
            self.left_out = 0
            self._maps += 1
            self.revision += 1

    def touch(self) -> None:
        """Count a change of something that is shown with the map."""
        with self._lock:
            self.revision += 1

    def put(
        self,
        anchor: int,
        source_revision: int,
        T_map_anchor: np.ndarray,
        cell_m: float,
        packed: bytes,
        pose_revision: int = 0,
    ) -> None:
        """Store the chunk of an anchor, unless it is older or coarser than the stored one; no Gaussians
        remove it.

        Args:
            source_revision: counts the changes of the chunk at its source.
            T_map_anchor: float64 [4, 4].
            cell_m: edge of the cells in which the source has merged Gaussians; 0 = none are merged.
            packed: by `splat_codec.pack`, in the anchor's frame.
            pose_revision: counts the moves of anchors at the source: the pose with the highest one is valid.

        Raises:
            ValueError: the bytes are no packed Gaussians.
        """
        count = extent_of(packed)[0]
        update = _Update(source_revision, PackedLevel(cell_m, count, packed))
        with self._lock:
            shown = self._chunks.get(anchor)
            known = self._pending.get(anchor) or (shown.update if shown is not None else None)
            if known is not None and (source_revision, -cell_m) <= known.order:
                return
            if count == 0:
                self._chunks.pop(anchor, None)
                self._pending.pop(anchor, None)
                self.revision += 1
                return
            self.move({anchor: T_map_anchor}, pose_revision)
            self._pending[anchor] = update
            if anchor not in self._chunks:
                self._publish(anchor, update, [update.level])

    def move(self, T_map_anchor: dict[int, np.ndarray], pose_revision: int = 0) -> None:
        """Set new poses [4, 4] of anchors; their Gaussians move with them. Poses from before are ignored."""
        with self._lock:
            for anchor, T in T_map_anchor.items():
                known, before = self._poses.get(anchor, (-1, None))
                if pose_revision >= known:
                    self._poses[anchor] = (pose_revision, np.array(T))
                    self.revision += before is None or not np.array_equal(before, T)

    def make_levels(self, now_s: float) -> bool:
        """Make the coarser levels of the chunk that waits longest; return False if none is due.

        `now_s` is a reading of `time.monotonic`.
        """
        with self._lock:
            due = (a for a in self._pending if now_s - self._made_s.get(a, -np.inf) >= _LEVELS_EVERY_S)
            anchor = next(due, None)
            if anchor is None:
                return False
            update, maps = self._pending[anchor], self._maps
            self._made_s[anchor] = now_s
        try:
            coarser = coarser_levels(
                unpack(np.frombuffer(update.level.packed, np.uint8)), update.level.cell_m
            )
        except ValueError:
            coarser = None
        with self._lock:
            if self._pending.get(anchor) is update:
                del self._pending[anchor]
            shown = self._chunks.get(anchor)
            if maps != self._maps or shown is None or shown.update.source_revision > update.source_revision:
                return True  # removed or replaced meanwhile
            if coarser is None:
                self.damaged += 1
                self._chunks.pop(anchor, None)
                self.revision += 1
            else:
                self._publish(anchor, update, [update.level, *coarser])
        return True

    def _publish(self, anchor: int, update: _Update, levels: list[PackedLevel]) -> None:
        """Replace the levels of a chunk; the same bytes keep their revision."""
        self._numbers += 1
        before = self._chunks.get(anchor)
        revision = before.revision if before is not None and before.update is update else self._numbers
        self._chunks[anchor] = _PackedChunk(revision, update, levels, self._numbers)
        self.revision += 1
        self._keep_budget()

    def _keep_budget(self) -> None:
        """Drop the finest levels, first those of the chunks that were used longest ago; then whole chunks.

        While coarser levels of a chunk are still to be made it stays: up to twice the budget is used then.
        """
        total = sum(chunk.bytes for chunk in self._chunks.values())
        while total > self.budget_bytes:
            reducible = [chunk for chunk in self._chunks.values() if len(chunk.levels) > 1]
            if reducible:
                chunk = min(reducible, key=lambda c: (c.levels[0].cell_m, c.used))
                total -= len(chunk.levels.pop(0).packed)
                chunk.coarsened = True
                continue
            oldest = sorted(self._chunks, key=lambda anchor: self._chunks[anchor].used)
            settled = [a for a in oldest if a not in self._pending or total > 2 * self.budget_bytes]
            if not settled:
                return
            total -= self._chunks.pop(settled[0]).bytes
            self.left_out += 1

    # --- read by the server ---

    @property
    def coarsened(self) -> int:
        """Number of chunks that are kept without their finest level."""
        with self._lock:
            return sum(chunk.coarsened for chunk in self._chunks.values())

    def index(self) -> list[dict[str, Any]]:
        """Return the chunks with the sizes of their levels, as data for JSON."""
        with self._lock:
            return [
                _entry(anchor, self._poses[anchor][1], chunk)
                for anchor, chunk in sorted(self._chunks.items())
            ]

    def level(self, anchor: int, revision: int, cell_m: float) -> bytes | None:
        """Return the packed Gaussians of a level; None if there is no such chunk, revision or level."""
        with self._lock:
            chunk = self._chunks.get(anchor)
            if chunk is None or chunk.revision != revision:
                return None
            self._numbers += 1
            chunk.used = self._numbers
            return next((level.packed for level in chunk.levels if level.cell_m == cell_m), None)

    def finest(self) -> dict[int, bytes]:
        """Return the packed Gaussians of the finest level of each chunk, by anchor."""
        with self._lock:
            return {anchor: chunk.levels[0].packed for anchor, chunk in sorted(self._chunks.items())}


def _entry(anchor: int, T_map_anchor: np.ndarray, chunk: _PackedChunk) -> dict[str, Any]:
    _, low, high = extent_of(chunk.levels[0].packed)
    return {
        "anchor": anchor, "revision": chunk.revision,
        "T_map_anchor": as_json(T_map_anchor), "low": as_json(low), "high": as_json(high),
        "levels": [{"cell_m": v.cell_m, "count": v.count, "bytes": len(v.packed)} for v in chunk.levels],
    }  # fmt: skip


def as_json(values: np.ndarray) -> list[float]:
    """Return the numbers of an array, row by row, to 0.1 micrometres (or radians)."""
    return [round(value, 7) for value in np.asarray(values, np.float64).ravel().tolist()]


def coarser_levels(params: np.ndarray, cell_m: float) -> list[PackedLevel]:
    """Return the levels of Gaussians float32 [14, N] that are coarser than `cell_m`, finest first.

    Each level is merged from the next finer one. A level that would save little is left out.
    """
    out: list[PackedLevel] = []
    for edge_m in LEVELS_M:
        if edge_m <= cell_m or params.shape[1] < _FEWEST:
            continue
        merged = merge_by_cell(params, edge_m)
        if merged.shape[1] <= _MIN_SAVING * params.shape[1]:
            params = merged
            out.append(PackedLevel(edge_m, params.shape[1], pack(params).tobytes()))
    return out
