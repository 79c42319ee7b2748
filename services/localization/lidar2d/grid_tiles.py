"""The occupancy grid as tiles that are drawn again only where the map has changed."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np

from beamsplat.common.mapfiles.grid_tiles import TILE_CELLS, pack_tile, unpack_tile
from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap
from beamsplat.services.localization.lidar2d.occupancy import CountGrid, TileSum, outline

TILES_PER_UPDATE = 24  # drawn at most; the others follow in the next updates, the oldest change first
# A subscriber that joins late receives the newest 1024 tiles from the publisher's cache (common/topics.py).
# An unchanged tile is sent again when so many others were sent after it: before it leaves the cache.
_RESEND_AFTER = 512
_REPEATED_TILES = 4  # of these, with each update
_QUIET_UPDATES = 6  # without any change, one tile is sent in so many updates: what was lost is healed slowly
_VISIBLE_PERCENT = 20  # of occupancy: less is not published before the end of the drive
_CACHED_SUMS = 32  # tiles whose sums of the finished submaps are kept: 1.3 MB each
_MOVED_CELLS = 0.4  # a submap is drawn again if a corner has moved by more, in cells of the grid

Place = tuple[int, int]  # row and column of a tile


@dataclass(frozen=True)
class MapContent:
    """What the grid is drawn from; it does not change while it is drawn in another thread."""

    finished: list[tuple[int, FrozenMap, np.ndarray]]  # id, map, pose_map_submap (float64 [3])
    growing: list[tuple[CountGrid, np.ndarray]]  # copies of the counts of the active submaps, with poses


@dataclass
class Work:
    """What was done since the creation of `GridTiles`, for tests of the cost."""

    tiles: int = 0  # drawn
    submaps: int = 0  # of which the counts were decompressed
    cells: int = 0  # visited to add a submap to a tile


@dataclass(frozen=True)
class _Drawn:
    """A finished submap as it is drawn in the grid."""

    frozen: FrozenMap
    pose_map_submap: np.ndarray
    places: frozenset[Place]


@dataclass(frozen=True)
class _FinishedSum:
    """Sum of the finished submaps in a tile, and these submaps by id."""

    total: TileSum
    parts: dict[int, _Drawn] = field(default_factory=dict)


class GridTiles:
    """Draws the tiles of the grid in which a submap was added, changed, moved or removed.

    The work of an update is bounded by `TILES_PER_UPDATE`, whatever the size of the map. Use it from one
    thread at a time.
    """

    def __init__(self, resolution_m: float) -> None:
        self.resolution_m = resolution_m
        self.work = Work()
        self.published: dict[Place, bytes] = {}  # packed tiles that contain known cells
        self._sent: dict[
            Place, int
        ] = {}  # published tiles, and the number of tiles sent before; oldest first
        self._sent_count = 0
        self._quiet = 0  # updates in a row without a tile to send
        self._drawn: dict[int, _Drawn] = {}
        self._covering: dict[Place, set[int]] = {}
        self._growing: frozenset[Place] = frozenset()
        self._dirty: dict[Place, None] = {}  # in order of their first change
        self._sums: OrderedDict[Place, _FinishedSum] = OrderedDict()

    @property
    def pending(self) -> int:
        """Return the number of changed tiles that have not been drawn yet."""
        return len(self._dirty)

    def update(self, content: MapContent, exact: bool = False) -> dict[Place, bytes]:
        """Draw the tiles that changed first; return the packed tiles that differ from the published ones.

        Args:
            exact: draw submaps again however little they have moved, and all tiles: at the end of a drive.
        """
        self._mark(content, 0.0 if exact else _MOVED_CELLS * self.resolution_m)
        changed: dict[Place, bytes] = {}
        while self._dirty:
            changed |= self._draw(list(self._dirty)[:TILES_PER_UPDATE], content, exact)
            if not exact:
                break
        return changed

    def to_send(self, changed: dict[Place, bytes]) -> dict[Place, bytes]:
        """Return the packed tiles to send in an update: the changed ones, and few others again.

        While nothing changes, that is one tile in `_QUIET_UPDATES` updates, if the map has up to
        `_RESEND_AFTER` tiles.
        """
        others = [place for place in self._sent if place not in changed]  # the oldest first
        aged = [p for p in others[:_REPEATED_TILES] if self._sent_count - self._sent[p] >= _RESEND_AFTER]
        self._quiet = 0 if changed or aged else self._quiet + 1
        if self._quiet == _QUIET_UPDATES:
            self._quiet, aged = 0, others[:1]
        out = changed | {place: self.published[place] for place in aged}
        for place, packed in out.items():
            self._sent.pop(place, None)
            if packed:
                self._sent[place] = self._sent_count
            self._sent_count += 1
        return out

    def _mark(self, content: MapContent, tolerance_m: float) -> None:
        """Find the tiles that must be drawn: where submaps are new, have changed, moved, or were removed."""
        present = set()
        for id, frozen, pose in content.finished:
            present.add(id)
            drawn = self._drawn.get(id)
            same = drawn is not None and drawn.frozen is frozen
            if same and _moved_m(frozen, self._drawn[id].pose_map_submap, pose) <= tolerance_m:
                continue
            self._remove(id)
            self._drawn[id] = _Drawn(frozen, pose, self._places(outline(frozen, pose)))
            for place in sorted(self._drawn[id].places):
                self._covering.setdefault(place, set()).add(id)
                self._dirty.setdefault(place)
        for id in sorted(self._drawn.keys() - present):
            self._remove(id)
            del self._drawn[id]
        growing = [self._places(outline(grid, pose)) for grid, pose in content.growing]
        now = frozenset().union(*growing)
        for place in sorted(now | self._growing):
            self._dirty.setdefault(place)
        self._growing = now

    def _remove(self, id: int) -> None:
        """Mark the tiles that a submap was drawn in."""
        for place in sorted(self._drawn[id].places) if id in self._drawn else ():
            self._covering[place].discard(id)
            if not self._covering[place]:
                del self._covering[place]
            self._dirty.setdefault(place)

    def _places(self, corners_m: np.ndarray) -> frozenset[Place]:
        """Return the tiles that a rectangle around corners [N, 2] touches."""
        scaled = corners_m / (TILE_CELLS * self.resolution_m)
        (x0, y0), (x1, y1) = np.floor(scaled.min(axis=0)).astype(int), np.ceil(scaled.max(axis=0)).astype(int)
        return frozenset((row, column) for row in range(y0, y1) for column in range(x0, x1))

    def _draw(self, places: list[Place], content: MapContent, exact: bool) -> dict[Place, bytes]:
        """Draw tiles; return the packed ones that differ from the published: visibly, or (`exact`) at all."""
        self._add_finished(places)
        changed = {}
        for place in places:
            del self._dirty[place]
            total = self._sums[place].total
            if content.growing:
                total = total.copy()
            for grid, pose in content.growing:
                self.work.cells += total.add(grid, grid.counts(), pose)
            cells, before = total.occupancy(), self.published.get(place, b"")
            packed = pack_tile(cells)
            self.work.tiles += 1
            if packed != before and (exact or _differs_visibly(cells, before)):
                changed[place] = packed
                self.published[place] = packed
                if not packed:
                    del self.published[place]
        while len(self._sums) > _CACHED_SUMS:
            self._sums.popitem(last=False)
        return changed

    def _add_finished(self, places: list[Place]) -> None:
        """Bring the sums of the finished submaps in these tiles up to date; each submap is unpacked once."""
        missing: dict[int, list[Place]] = {}
        for place in places:
            wanted = {id: self._drawn[id] for id in self._covering.get(place, ())}
            cached = self._sums.pop(place, None)
            if cached is None or any(wanted.get(id) is not part for id, part in cached.parts.items()):
                corner = place[0] * TILE_CELLS, place[1] * TILE_CELLS
                shape = (TILE_CELLS, TILE_CELLS)
                cached = _FinishedSum(TileSum.empty(*corner, shape, self.resolution_m))
            self._sums[place] = cached
            for id in wanted.keys() - cached.parts.keys():
                missing.setdefault(id, []).append(place)
        for id in sorted(missing):
            drawn = self._drawn[id]
            counts = drawn.frozen.counts()
            self.work.submaps += 1
            for place in missing[id]:
                total = self._sums[place]
                self.work.cells += total.total.add(drawn.frozen, counts, drawn.pose_map_submap)
                total.parts[id] = drawn


def _differs_visibly(cells: np.ndarray, before: bytes) -> bool:
    """Return whether a cell became known or unknown, or changed by `_VISIBLE_PERCENT`, since a packed tile.

    At rest, scans that hit a wall or miss it by a hair change the counts for ever, but not the picture.
    """
    published = unpack_tile(before, TILE_CELLS).astype(np.int16)
    change = np.abs(cells - published) >= _VISIBLE_PERCENT
    return bool((change | ((cells < 0) != (published < 0))).any())


def _moved_m(frozen: FrozenMap, before: np.ndarray, now: np.ndarray) -> float:
    """Return the largest motion (m) of a corner of a submap between two poses [3]."""
    if np.array_equal(before, now):
        return 0.0
    return float(np.hypot(*(outline(frozen, now) - outline(frozen, before)).T).max())
