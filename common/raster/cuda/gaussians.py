"""The Gaussians with their optimiser state in device memory: the twin of `optimiser.GaussianArrays`."""

from __future__ import annotations

import numpy as np
import torch

from beamsplat.common.geometry.transforms import quat_wxyz_from_matrix
from beamsplat.common.harmonics.basis import coefficients, rotation_of
from beamsplat.common.raster.cuda.source import BLOCK, Kernels, filled
from beamsplat.common.raster.layout import COLOUR, OPACITY, PARAMS, SCALE

ARRAYS = ("params", "first", "second", "steps", "carving_votes")
HARMONICS = ("harmonics", "harmonics_first", "harmonics_second")


class DeviceGaussians:
    """Parameters, Adam state and carving votes of Gaussians, in growable tensors.

    Columns 0 to count - 1 are in use. `params`, `first` and `second` are float32 [14, capacity], `steps`
    float32 [capacity], `carving_votes` int32 [capacity], with the rows of `raster.layout`. `generation`
    changes whenever the tensors are allocated anew: launches prepared before use freed memory then.
    Tensors grow by half of their size, but beyond `limit` columns by what is needed only.

    With a degree of harmonics, `harmonics` and their moments are float32 [3 K, capacity], and `turned`
    is a buffer float32 [3, capacity]. `shown` float32 [3, capacity] are the colours that are rendered.
    """

    harmonics: torch.Tensor | None
    harmonics_first: torch.Tensor | None
    harmonics_second: torch.Tensor | None

    def __init__(self, kernels: Kernels, capacity: int = 4096, degree: int = 0) -> None:
        self._kernels = kernels
        self.degree = degree
        self.arrays = (*ARRAYS, *HARMONICS) if degree else ARRAYS
        self._count = 0
        self.generation = 0
        self.limit: int | None = None
        self.count_on_device = torch.zeros(1, dtype=torch.int32, device=kernels.device)
        capacity = _rounded(capacity)
        self.params, self.first, self.second = (self._zeros(PARAMS, capacity) for _ in range(3))
        self.steps = self._zeros(capacity)
        self.carving_votes = self._zeros(capacity, dtype=torch.int32)
        for name in HARMONICS:
            tensor = self._zeros(3 * coefficients(degree), capacity) if degree else None
            setattr(self, name, tensor)
        self._allocate_shown()

    def _allocate_shown(self) -> None:
        self.turned = self._zeros(3, self.capacity) if self.degree else None
        self.shown = self._zeros(3, self.capacity) if self.degree else self.params[COLOUR:]

    def _zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.zeros(shape, dtype=dtype, device=self._kernels.device)

    @property
    def count(self) -> int:
        """Number of Gaussians in use."""
        return self._count

    def _set_count(self, count: int) -> None:
        self._count = count
        self.count_on_device.fill_(count)

    @property
    def capacity(self) -> int:
        """Number of allocated columns, a multiple of 256."""
        return self.params.shape[1]

    @property
    def bytes_each(self) -> int:
        """Bytes of one Gaussian in all tensors."""
        return self.copied_bytes_each + (24 if self.degree else 0)  # `shown` and `turned`

    @property
    def copied_bytes_each(self) -> int:
        """Bytes of one Gaussian in the result of `read`."""
        return sum(getattr(self, name).nbytes for name in self.arrays) // self.capacity

    def append(self, params: np.ndarray) -> slice:
        """Append Gaussians float32 [14, M] with zero optimiser state; return their columns as a slice."""
        new = params.shape[1]
        if self._count + new > self.capacity:
            self.resize(max(self._count + new, self.bounded(self.capacity + self.capacity // 2)))
        at = slice(self._count, self._count + new)
        for name in self.arrays[1:]:
            getattr(self, name)[..., at] = 0
        self.params[:, at] = torch.from_numpy(np.ascontiguousarray(params, np.float32)).to(
            self._kernels.device
        )
        self._set_count(self._count + new)
        return at

    def bounded(self, capacity: int) -> int:
        """Return a capacity, reduced to `limit` if it is larger."""
        return capacity if self.limit is None else min(capacity, self.limit)

    def resize(self, capacity: int) -> None:
        """Allocate tensors for `capacity` Gaussians, at least `count`; one after the other."""
        capacity = _rounded(max(capacity, self._count))
        for name in self.arrays:
            old = getattr(self, name)
            new = self._zeros(*old.shape[:-1], capacity, dtype=old.dtype)
            new[..., : self._count] = old[..., : self._count]
            setattr(self, name, new)
            del old
        self._allocate_shown()
        self.generation += 1

    def keep(self, mask: np.ndarray) -> int:
        """Remove the Gaussians where `mask` bool [count] is False, and return their number.

        The others stay in the same order.
        """
        chosen = np.flatnonzero(mask)
        dropped = self._count - len(chosen)
        if dropped:
            index = torch.from_numpy(chosen).to(self._kernels.device)
            for name in self.arrays:
                tensor = getattr(self, name)
                tensor[..., : len(chosen)] = tensor.index_select(tensor.ndim - 1, index)
            self._set_count(len(chosen))
        return dropped

    def truncate(self, count: int) -> None:
        """Remove all Gaussians from column `count` on."""
        self._set_count(min(count, self._count))

    def rows(self, first: int, stop: int) -> np.ndarray:
        """Return rows of the parameters, float32 [stop - first, count]. Waits for the device."""
        return self.params[first:stop, : self._count].cpu().numpy().copy()

    def nearest_m(self, group: np.ndarray, at_map_m: np.ndarray) -> float:
        """Return the smallest distance (m) from a point float64 [3] to the centres of `group` int [M].

        It is inf without any. Waits for the device.
        """
        if len(group) == 0:
            return float("inf")
        index = torch.from_numpy(np.asarray(group, np.int64)).to(self._kernels.device)
        means = self.params[:SCALE].index_select(1, index).double()
        at = torch.from_numpy(np.asarray(at_map_m, np.float64)).to(self._kernels.device)
        return float(((means - at[:, None]) ** 2).sum(0).min().sqrt())

    def survivors(self, votes: int, opacity_logit: float) -> np.ndarray:
        """Return bool [count]: Gaussians with fewer votes and a higher opacity. Waits for the device."""
        few = self.carving_votes[: self._count] < votes
        return (few & (self.params[OPACITY, : self._count] > opacity_logit)).cpu().numpy()

    def read(
        self, group: np.ndarray | slice | None = None, names: tuple[str, ...] | None = None
    ) -> dict[str, np.ndarray]:
        """Return copies of the tensors as arrays, reduced to the columns `group` (default: those in use).

        Waits for the device.
        """
        names = self.arrays if names is None else names
        columns = slice(0, self._count) if group is None else group
        if isinstance(columns, slice):
            return {name: getattr(self, name)[..., columns].cpu().numpy().copy() for name in names}
        index = torch.from_numpy(np.asarray(columns, np.int64)).to(self._kernels.device)
        return {
            name: getattr(self, name).index_select(getattr(self, name).ndim - 1, index).cpu().numpy()
            for name in names
        }

    def write(self, columns: slice, arrays: dict[str, np.ndarray]) -> None:
        """Overwrite columns in use by arrays as `read` returns them; tensors without an array stay."""
        for name, array in arrays.items():
            tensor = getattr(self, name)
            tensor[..., columns] = torch.from_numpy(np.ascontiguousarray(array)).to(
                tensor.device, tensor.dtype
            )

    def move(self, group: np.ndarray, T_new_old: np.ndarray) -> None:
        """Transform the Gaussians `group` int [M] rigidly: means, rotations and Adam's first moments."""
        if len(group) == 0:
            return
        columns = torch.from_numpy(np.asarray(group, np.int32)).to(self._kernels.device)
        arguments = filled(
            self._kernels.source.structures["MoveArguments"], params=self.params, first=self.first,
            columns=columns, rotation=T_new_old[:3, :3].ravel(), translation=T_new_old[:3, 3],
            quat=quat_wxyz_from_matrix(T_new_old[:3, :3]), stride=self.capacity, count=len(group),
        )  # fmt: skip
        self._kernels.launch("move_gaussians", -(-len(group) // BLOCK), arguments)
        if self.degree:
            self._turn_harmonics(columns.long(), T_new_old[:3, :3])

    def _turn_harmonics(self, columns: torch.Tensor, R_new_old: np.ndarray) -> None:
        turn = torch.from_numpy(rotation_of(R_new_old, self.degree)).to(self._kernels.device, torch.float32)
        for name in HARMONICS[:2]:
            tensor = getattr(self, name)
            blocks = tensor[:, columns].reshape(3, len(turn), -1)
            tensor[:, columns] = (turn @ blocks).reshape(len(tensor), -1)

    def vote_carving(
        self,
        targets: torch.Tensor,
        camera: np.ndarray,
        size: tuple[int, int],
        least_weight: int,
        margin: float,
    ) -> None:
        """Add a carving vote to each Gaussian that floats in front of a trusted surface of a keyframe.

        Args:
            targets: of the keyframe, see `targets.pack_targets`.
            camera: float32 [24], result of `RasterCamera.packed`.
            size: width and height of the targets, px.
            least_weight: depths of a lower weight (0 to 255) are not trusted.
            margin: relative distance to the surface from which a Gaussian is floating.
        """
        arguments = filled(
            self._kernels.source.structures["CarveArguments"], params=self.params, votes=self.carving_votes,
            targets=targets, camera=camera, margin=margin, stride=self.capacity, count=self._count,
            width=size[0], height=size[1], least_weight=least_weight,
        )  # fmt: skip
        self._kernels.launch("vote_carving", -(-max(self._count, 1) // BLOCK), arguments)


def _rounded(capacity: int) -> int:
    return -(-max(capacity, 1) // BLOCK) * BLOCK
