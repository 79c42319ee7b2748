"""The Gaussians of a device as a `GaussianStore`: sessions, paging and chunks read them as arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from beamsplat.common.mapfiles.store import GaussianStore, saved_name

if TYPE_CHECKING:
    from beamsplat.common.raster.cuda.gaussians import DeviceGaussians


class DeviceStore(GaussianStore):
    """A `GaussianStore` whose arrays are in device memory; only `anchor` is on the host.

    Reading `params`, `first`, `second`, `steps` or `carving_votes` copies the array to the host, once until
    it changes. These copies are read-only: all changes go through the methods. Call `changed` after the
    device has changed the Gaussians.
    """

    def __init__(self, gaussians: DeviceGaussians) -> None:
        self.gaussians = gaussians
        self._copies: dict[str, np.ndarray] = {}
        super().__init__(gaussians.capacity, gaussians.degree)

    def changed(self) -> None:
        """Forget the copies on the host."""
        self._copies.clear()

    # --- arrays on the device ---

    def _copy(self, name: str) -> np.ndarray:
        if name not in self._copies:
            array = self.gaussians.read(names=(name,))[name]
            # The CPU rasterizer, which renders exports and reports, reads blocks of 16 columns.
            padding = [(0, 0)] * (array.ndim - 1) + [(0, -array.shape[-1] % 16)]
            array = np.ascontiguousarray(np.pad(array, padding))
            array.setflags(write=False)
            self._copies[name] = array
        return self._copies[name]

    params = property(lambda self: self._copy("params"))
    first = property(lambda self: self._copy("first"))
    second = property(lambda self: self._copy("second"))
    steps = property(lambda self: self._copy("steps"))
    carving_votes = property(lambda self: self._copy("carving_votes"))
    harmonics = property(lambda self: self._copy("harmonics"))
    harmonics_first = property(lambda self: self._copy("harmonics_first"))
    harmonics_second = property(lambda self: self._copy("harmonics_second"))

    @property
    def capacity(self) -> int:
        """Number of allocated columns."""
        return self.gaussians.capacity

    @property
    def bytes_each(self) -> int:
        """See `GaussianStore.bytes_each`: those of its anchor."""
        return self.anchor.itemsize

    @property
    def copied_bytes_each(self) -> int:
        """See `GaussianStore.copied_bytes_each`."""
        return self.gaussians.copied_bytes_each + self.anchor.itemsize

    def limit_capacity(self, count: int) -> None:
        """See `GaussianStore.limit_capacity`."""
        self.gaussians.limit = count

    def _allocate(self, capacity: int) -> None:
        """Allocate anew: `count` Gaussians, all zero."""
        g = self.gaussians
        g.keep(np.zeros(g.count, bool))
        g.resize(capacity)
        if self.count:
            g.append(np.zeros((14, self.count), np.float32))
        self.anchor = np.zeros(g.capacity, np.int64)
        self.changed()

    def append(self, params: np.ndarray) -> slice:
        """See `GaussianArrays.append`."""
        at = self.gaussians.append(params)
        self._fit_anchors()
        self.anchor[at] = 0
        self.count = at.stop
        self.changed()
        return at

    def resize(self, capacity: int) -> None:
        """See `GaussianArrays.resize`."""
        self.gaussians.resize(self.gaussians.bounded(capacity))
        self._fit_anchors()

    def _fit_anchors(self) -> None:
        if len(self.anchor) != self.gaussians.capacity:
            before, self.anchor = self.anchor, np.zeros(self.gaussians.capacity, np.int64)
            self.anchor[: self.count] = before[: self.count]

    def _compact(self, chosen: np.ndarray) -> None:
        mask = np.zeros(self.count, bool)
        mask[chosen] = True
        self.gaussians.keep(mask)
        self.anchor[: len(chosen)] = self.anchor[chosen]
        self.changed()

    def _write(self, name: str, at: slice, values: np.ndarray | int) -> None:
        if name == "anchor":
            self.anchor[at] = values
        else:
            self.gaussians.write(at, {name: np.asarray(values)})
            self.changed()

    def _transform(self, chosen: np.ndarray, T_new_old: np.ndarray) -> None:
        self.gaussians.move(chosen, T_new_old)
        self.changed()

    def _copied(self, name: str) -> np.ndarray:
        if name == "anchor":
            return self.anchor[: self.count].copy()
        return self.gaussians.read(names=(name,))[name]

    # --- reading without a copy of everything ---

    def rows(self, first: int, stop: int) -> np.ndarray:
        """See `GaussianStore.rows`."""
        return self.gaussians.rows(first, stop)

    def selected(self, group: np.ndarray) -> np.ndarray:
        """See `GaussianStore.selected`."""
        return self.gaussians.read(group, ("params",))["params"]

    def chunk(self, anchor: int) -> np.ndarray:
        """See `GaussianStore.chunk`."""
        return self.selected(np.flatnonzero(self.anchor[: self.count] == anchor))

    def nearest_m(self, anchor: int, at_map_m: np.ndarray) -> float:
        """See `GaussianStore.nearest_m`."""
        return self.gaussians.nearest_m(np.flatnonzero(self.anchor[: self.count] == anchor), at_map_m)

    def survivors(self, votes: int, opacity_logit: float) -> np.ndarray:
        """See `GaussianStore.survivors`."""
        return self.gaussians.survivors(votes, opacity_logit)

    def columns(self, group: np.ndarray) -> dict[str, np.ndarray]:
        """See `GaussianStore.columns`."""
        return {saved_name(name): array for name, array in self.gaussians.read(group).items()}
