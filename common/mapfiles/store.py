"""The Gaussians of the map: each is bound to an anchor; the Gaussians of one anchor form a chunk."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from beamsplat.common.geometry.transforms import quat_wxyz_from_matrix
from beamsplat.common.harmonics.basis import coefficients, rotated, with_degree
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import MEAN, OPACITY, PARAMS, QUAT, SCALE
from beamsplat.common.raster.optimiser import GaussianArrays

# Added to the events of each anchor when a state is restored. More than the events of one anchor between two
# checkpoints, so that no version published since the checkpoint is used again for other data.
_VERSION_LEAP = 1000
# Coefficients of spherical harmonics and Adam's moments of them, float32 [3 K, N] each.
HARMONIC_ARRAYS = ("harmonics", "harmonics_first", "harmonics_second")
_SAVED_NAMES = {"carving_votes": "strikes"}  # attribute -> name in saved files, where they differ


class DiskGaussians(Protocol):
    """Read access to Gaussians that are stored on disk and not in memory."""

    def read(self, anchor: int, T_map_anchor: np.ndarray, degree: int = 0) -> Iterator[np.ndarray]:
        """Yield the Gaussians of an anchor in parts, float32 [14 + 3 K, N] each, in the map frame.

        The rows from 14 on are spherical harmonics of the degree.
        """

    def nearest_m(self, anchor: int, T_map_anchor: np.ndarray, at_map_m: np.ndarray) -> float:
        """Return a lower bound on the distance (m) from a point to the Gaussians of an anchor.

        `at_map_m` is the point [3] in the map frame. The result is inf if no Gaussians are on disk.
        """

    def read_visible(
        self,
        camera: RasterCamera,
        T_map_camera: np.ndarray,
        T_map_anchor: dict[int, np.ndarray],
        max_count: int,
    ) -> tuple[list[np.ndarray], int]:
        """Read at most `max_count` Gaussians that a camera may see, the nearest first.

        Returns:
            Parts float32 [14, N] in the map frame, and the number of Gaussians left out.
        """


@dataclass(frozen=True)
class Chunk:
    """The Gaussians of one anchor. `version` changes whenever one of them changes in the anchor's frame."""

    anchor: int
    version: int
    params: np.ndarray  # float32 [14, N], in the map frame


@dataclass(frozen=True)
class Census:
    """Which Gaussians in memory belong to which anchor, and the version of each chunk, at one time."""

    versions: dict[int, int]  # anchor -> version, of all chunks, also of those on disk only
    order: np.ndarray  # int64 [count], columns of the store, ordered by anchor
    anchors: list[int]  # with Gaussians in memory, ascending
    starts: np.ndarray  # int64 [len(anchors)], of each anchor in `order`

    def columns(self) -> dict[int, np.ndarray]:
        """Return the columns int64 [N] of each anchor in memory, ascending."""
        return dict(zip(self.anchors, np.split(self.order, self.starts[1:])))


class GaussianStore(GaussianArrays):
    """Gaussians with their anchors, carving votes and chunk versions.

    With a degree, `harmonics`, `harmonics_first` and `harmonics_second` are float32 [3 K, capacity].
    """

    harmonics: np.ndarray
    harmonics_first: np.ndarray
    harmonics_second: np.ndarray

    def __init__(self, capacity: int = 4096, degree: int = 0) -> None:
        """`degree` is that of the spherical harmonics of colours, see `common.harmonics`; 0 = none."""
        self.degree = degree
        self._events: dict[int, int] = {}  # per anchor: insertions and removals so far
        self.paged_out: dict[int, tuple[int, int]] = {}  # per anchor: (Gaussians, their steps) on disk only
        super().__init__(capacity)

    def _allocate(self, capacity: int) -> None:
        super()._allocate(capacity)
        self.anchor = np.zeros(capacity, np.int64)
        self.carving_votes = np.zeros(capacity, np.int32)  # views with a trusted surface behind the Gaussian
        for name in self._harmonic_arrays():
            setattr(self, name, np.zeros((3 * coefficients(self.degree), capacity), np.float32))

    def _arrays(self) -> list[str]:
        return [*super()._arrays(), "anchor", "carving_votes", *self._harmonic_arrays()]

    def _harmonic_arrays(self) -> tuple[str, ...]:
        return HARMONIC_ARRAYS if self.degree else ()

    @property
    def bytes_each(self) -> int:
        """Return the bytes of one Gaussian in host memory."""
        return self.copied_bytes_each

    @property
    def copied_bytes_each(self) -> int:
        """Return the bytes of one Gaussian in the result of `state`."""
        return sum(getattr(self, name).nbytes for name in self._arrays()) // self.capacity

    def limit_capacity(self, count: int) -> None:
        """Set the number of Gaussians beyond which arrays grow no further than needed.

        No effect on arrays in host memory: unused columns take none.
        """

    def state(self) -> dict[str, np.ndarray]:
        """Return copies of all arrays, trimmed to `count` columns, and the event counters.

        The keys are the names in saved files.
        """
        out = {saved_name(name): self._copied(name) for name in self._arrays()}
        out["events"] = np.array(list(self._events.items()), np.int64).reshape(-1, 2)
        return out

    def _copied(self, name: str) -> np.ndarray:
        """Return a copy of an array, trimmed to `count` columns."""
        return getattr(self, name)[..., : self.count].copy()

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Replace the contents by a result of `state`.

        The chunk versions become higher than all versions published since `state` was called.

        Raises:
            KeyError: an array is missing.
        """
        self.count = state["params"].shape[1]
        self._allocate(-(-max(self.count, 1) // 16) * 16)
        for name in self._arrays():
            self._write(name, slice(0, self.count), self._saved(name, state))
        self._events = {anchor: events + _VERSION_LEAP for anchor, events in state["events"].tolist()}

    def _saved(self, name: str, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """Return an array of a saved state; harmonics of another degree are completed by zeros, or reduced.

        Raises:
            KeyError: the array is missing.
        """
        if name not in HARMONIC_ARRAYS:
            return arrays[saved_name(name)]
        none = np.zeros((0, arrays["params"].shape[1]), np.float32)
        return with_degree(arrays.get(name, none), self.degree)

    def add(self, params: np.ndarray, anchor: int) -> None:
        """Append Gaussians float32 [14, M], in the map frame, bound to an anchor."""
        at = self.append(params)  # may reallocate the arrays: read `self.anchor` only afterwards
        self.anchor[at] = anchor
        self._events[anchor] = self._events.get(anchor, 0) + 1

    def keep(self, mask: np.ndarray) -> int:
        """Remove the Gaussians where `mask` bool [count] is False, and return their number.

        The others stay in the same order.
        """
        for anchor in np.unique(self.anchor[: self.count][~np.asarray(mask)]):
            self._events[int(anchor)] = self._events.get(int(anchor), 0) + 1
        return super().keep(mask)

    @property
    def paged_out_count(self) -> int:
        """Return the number of Gaussians that are on disk only."""
        return sum(count for count, _ in self.paged_out.values())

    def page_out(self, groups: list[np.ndarray]) -> None:
        """Free Gaussians that have been written to disk. Versions do not change: the map is the same.

        Args:
            groups: int [N] columns each; all columns of a group have the same anchor.
        """
        stay = np.ones(self.count, bool)
        for group in groups:
            self.count_paged_out(int(self.anchor[group[0]]), len(group), _sum(self.steps[group]))
            stay[group] = False
        super().keep(stay)
        self.resize(self.count + self.count // 4)

    def page_in(self, arrays: dict[str, np.ndarray], anchor: int) -> None:
        """Append Gaussians read back from disk, as `columns` returned them."""
        count = arrays["params"].shape[1]
        at = self.append(arrays["params"])
        for name in self._arrays()[1:]:
            self._write(name, at, anchor if name == "anchor" else self._saved(name, arrays))
        self.count_paged_out(anchor, -count, -_sum(arrays["steps"]))

    def columns(self, group: np.ndarray) -> dict[str, np.ndarray]:
        """Return copies of all arrays except `anchor`, reduced to the columns `group` int [N].

        The keys are the names in saved files.
        """
        names = (name for name in self._arrays() if name != "anchor")
        return {saved_name(name): getattr(self, name)[..., group] for name in names}

    def count_paged_out(self, anchor: int, count: int, steps: int) -> None:
        """Record that `count` more Gaussians of an anchor are on disk only.

        `steps` is the sum of their optimiser steps. Negative values record the opposite.
        """
        before = self.paged_out.pop(anchor, (0, 0))
        if before[0] + count:
            self.paged_out[anchor] = (before[0] + count, before[1] + steps)

    def discard_paged_out(self, anchor: int, count: int, steps: int) -> None:
        """Record the loss of `count` Gaussians of an anchor on disk; the version of the chunk grows.

        Called when their block file cannot be read any more. `steps` is the sum of their optimiser steps.
        """
        self.count_paged_out(anchor, -count, -steps)
        self._events[anchor] = self._events.get(anchor, 0) + 1

    def move(self, anchor: int, T_new_old: np.ndarray) -> None:
        """Transform the Gaussians of an anchor rigidly: means, rotations, and Adam's first moments.

        The version of the chunk stays: in the frame of the anchor, which moves too, nothing has changed.
        """
        chosen = np.flatnonzero(self.anchor[: self.count] == anchor)
        if len(chosen):
            self._transform(chosen, T_new_old)

    def _transform(self, chosen: np.ndarray, T_new_old: np.ndarray) -> None:
        """Transform the columns `chosen` and their first moments."""
        self.params[:, chosen], self.first[:, chosen] = transform_with_momentum(
            self.params[:, chosen], self.first[:, chosen], T_new_old
        )
        for name in self._harmonic_arrays()[:2]:
            array = getattr(self, name)
            array[:, chosen] = rotated(array[:, chosen], T_new_old[:3, :3])

    def census(self) -> Census:
        """Return which Gaussians in memory belong to which anchor, and the versions of all chunks."""
        anchors = self.anchor[: self.count]
        order = np.argsort(anchors, kind="stable")  # nearly sorted: Gaussians are inserted in runs
        in_order = anchors[order]
        starts = np.flatnonzero(np.diff(in_order, prepend=in_order[:1] - 1))
        ids = in_order[starts].tolist()
        in_steps = self.steps[: self.count][order].astype(np.float64)
        steps = np.add.reduceat(in_steps, starts).tolist() if ids else []
        taken = {anchor: int(n) for anchor, n in zip(ids, steps)}
        for anchor, (_, n) in self.paged_out.items():
            taken[anchor] = taken.get(anchor, 0) + n
        # One event counts more than all steps: a removal lowers their sum, but the version must grow.
        versions = {a: (events << 40) + taken.get(a, 0) for a, events in sorted(self._events.items())}
        return Census(versions, order, ids, starts)

    def versions(self) -> dict[int, int]:
        """Return the version of each chunk, by anchor id.

        A version grows with each optimiser step, insertion and removal of Gaussians in the chunk.
        """
        return self.census().versions

    def chunk(self, anchor: int) -> np.ndarray:
        """Return a copy of an anchor's Gaussians in memory, float32 [14, N], in the map frame."""
        return self.params[:, : self.count][:, self.anchor[: self.count] == anchor]

    # What the clients of an engine read: a store in device memory computes or copies just this.

    def rows(self, first: int, stop: int) -> np.ndarray:
        """Return the rows `first` to `stop` - 1 of the parameters, float32 [rows, count]; read-only."""
        return self.params[first:stop, : self.count]

    def with_harmonics(self) -> np.ndarray:
        """Return the parameters and below them the harmonics, float32 [14 + 3 K, count]: all of the look."""
        if not self.degree:
            return self.rows(0, PARAMS)
        return np.concatenate([self.rows(0, PARAMS), self._copied("harmonics")])

    def selected(self, group: np.ndarray) -> np.ndarray:
        """Return a copy of the parameters of the columns `group` int [N], float32 [14, N]."""
        return self.params[:, group]

    def nearest_m(self, anchor: int, at_map_m: np.ndarray) -> float:
        """Return the distance (m) from a point float64 [3] to the nearest centre of an anchor's Gaussians.

        It is inf if none is in memory.
        """
        means = self.params[MEAN:SCALE, : self.count][:, self.anchor[: self.count] == anchor].T
        return float(np.sqrt(np.min(np.sum((means - at_map_m) ** 2, axis=1), initial=np.inf)))

    def survivors(self, votes: int, opacity_logit: float) -> np.ndarray:
        """Return bool [count]: Gaussians with fewer carving votes than `votes` and a higher opacity."""
        opaque = self.params[OPACITY, : self.count] > opacity_logit
        return (self.carving_votes[: self.count] < votes) & opaque

    def chunks(self, known: dict[int, int] | None = None) -> list[Chunk]:
        """Return copies of the chunks whose version differs from that in `known` (default: all chunks)."""
        known = known or {}
        return [
            Chunk(a, version, self.chunk(a))
            for a, version in self.versions().items()
            if known.get(a) != version
        ]


def saved_name(name: str) -> str:
    """Return the name of an array in saved files."""
    return _SAVED_NAMES.get(name, name)


def _sum(steps: np.ndarray) -> int:
    return int(steps.sum(dtype=np.float64))


def transform_gaussians(params: np.ndarray, T_a_b: np.ndarray) -> np.ndarray:
    """Transform Gaussians float32 [14, N] from frame b to frame a."""
    out = params.copy()
    out[MEAN:SCALE] = T_a_b[:3, :3] @ params[MEAN:SCALE].astype(np.float64) + T_a_b[:3, 3:4]
    out[QUAT:OPACITY] = _left_product(T_a_b[:3, :3]) @ params[QUAT:OPACITY]
    return out


def transform_with_momentum(
    params: np.ndarray, first: np.ndarray, T_a_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Transform Gaussians and their Adam first moments, float32 [14, N] each, from frame b to frame a."""
    R, turned = T_a_b[:3, :3], first.copy()
    turned[MEAN:SCALE] = R @ first[MEAN:SCALE]
    turned[QUAT:OPACITY] = _left_product(R) @ first[QUAT:OPACITY]
    return transform_gaussians(params, T_a_b), turned


def _left_product(R: np.ndarray) -> np.ndarray:
    """Return the matrix [4, 4] that multiplies quaternions (w, x, y, z) by the rotation R from the left."""
    w, x, y, z = quat_wxyz_from_matrix(R)
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
