"""The Gaussian map as a coloured point cloud of bounded size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.transforms import transform_points
from beamsplat.common.mapfiles.anchor_poses import AnchorPoses
from beamsplat.common.messages.splat_codec import unpack
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, SCALE

_MIN_OPACITY_LOGIT = 0.0  # opacity 0.5: what is more transparent is haze rather than a surface
_COARSEST_CELL_M = 1000.0  # larger than any map: beyond it, cells are not made coarser
_MAX_SUBMAPS = 100_000
_CELL_BITS = 21  # of a cell index per axis: 52 km in each direction at 5 cm


@dataclass(frozen=True)
class _Submap:
    revision: int
    points_m: np.ndarray  # float32 [N, 3], anchor frame
    colours: np.ndarray  # uint8 [N, 3], RGB


class SplatCloud:
    """Collects the chunks of the map and thins their Gaussians to at most `max_points` points.

    One Gaussian per grid cell of its submap is kept, the most opaque one. If there are too many points, the
    cells of all submaps are made twice as large, for good: so the memory is bounded too.
    """

    def __init__(self, max_points: int, cell_m: float) -> None:
        self._max_points = max_points
        self._initial_cell_m = self.cell_m = cell_m
        self._producer = ""  # instance of the mapper process that sent the chunks
        self._submaps: dict[int, _Submap] = {}
        self._poses = AnchorPoses()
        self.changed = False  # since the last call of `points`

    def add(
        self,
        producer: str,
        anchor: int,
        revision: int,
        pose: tuple[int, np.ndarray],  # its revision, and T_map_anchor float64 [4, 4]
        packed: np.ndarray,  # uint8 [B], encoded by `splat_codec`
    ) -> None:
        """Store the Gaussians of one submap instead of its earlier ones; older revisions are ignored.

        A chunk of another `producer` begins another map.

        Raises:
            ValueError: the bytes are no packed Gaussians, or there are too many submaps.
        """
        self._start_map(producer)
        self.move(producer, pose[0], {anchor: pose[1]})
        known = self._submaps.get(anchor)
        if known is not None and revision < known.revision:
            return
        if known is None and len(self._submaps) >= _MAX_SUBMAPS:
            raise ValueError(f"the map has more than {_MAX_SUBMAPS} submaps")
        params = unpack(packed)
        params = params[:, params[OPACITY] >= _MIN_OPACITY_LOGIT]
        params = params[:, np.argsort(-params[OPACITY], kind="stable")]
        colours = (np.clip(params[COLOUR:], 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8).T
        points_m = np.ascontiguousarray(params[MEAN:SCALE].T)
        submap = _Submap(revision, points_m, np.ascontiguousarray(colours))
        self._submaps[anchor] = _thinned(submap, self.cell_m)
        self.changed = True
        self._keep_limit()

    def move(self, producer: str, revision: int, T_map_anchor: dict[int, np.ndarray]) -> None:
        """Store the poses (float64 [4, 4]) of submaps, unless newer ones are known.

        Raises:
            ValueError: there are too many submaps.
        """
        self._start_map(producer)
        moved = self._poses.update(revision, T_map_anchor.items())
        self.changed = self.changed or any(anchor in self._submaps for anchor in moved)

    def _start_map(self, producer: str) -> None:
        """Forget the map of another process of the mapper."""
        if self._producer and producer != self._producer:
            self.changed = self.changed or bool(self._submaps)
            self._submaps.clear()
            self._poses.clear()
            self.cell_m = self._initial_cell_m
        self._producer = producer

    def complete(self, other: SplatCloud) -> None:
        """Add the submaps of `other`, a snapshot of the same map, that are not known yet."""
        for anchor, submap in other._submaps.items():
            if anchor not in self._submaps and len(self._submaps) < _MAX_SUBMAPS:
                self._submaps[anchor] = _thinned(submap, self.cell_m)
                self._poses.update(*other._poses.entry(anchor))
                self.changed = True
                self._keep_limit()

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return points float32 [N, 3] (m, map frame) and colours uint8 [N, 3] (RGB), ordered by submap."""
        self.changed = False
        anchors = sorted(self._submaps)
        submaps = [self._submaps[anchor] for anchor in anchors]
        points = [
            transform_points(self._poses.pose(a), s.points_m.astype(np.float64))
            for a, s in zip(anchors, submaps)
        ]
        if not points:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
        colours = np.concatenate([s.colours for s in submaps])
        return np.concatenate(points).astype(np.float32)[: self._max_points], colours[: self._max_points]

    def _keep_limit(self) -> None:
        while self._count() > self._max_points and self.cell_m < _COARSEST_CELL_M:
            self.cell_m *= 2.0
            self._submaps = {a: _thinned(s, self.cell_m) for a, s in self._submaps.items()}

    def _count(self) -> int:
        return sum(len(submap.points_m) for submap in self._submaps.values())


def _thinned(submap: _Submap, cell_m: float) -> _Submap:
    """Return the submap with the first point of each grid cell of edge `cell_m`, in the same order."""
    limit = 1 << (_CELL_BITS - 1)
    cells = (
        np.floor(submap.points_m.astype(np.float64) / cell_m).clip(-limit, limit - 1).astype(np.int64) + limit
    )
    key = (cells[:, 0] << 2 * _CELL_BITS) | (cells[:, 1] << _CELL_BITS) | cells[:, 2]
    _, first = np.unique(key, return_index=True)
    first.sort()
    return _Submap(submap.revision, submap.points_m[first], submap.colours[first])
