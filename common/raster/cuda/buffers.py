"""Working memory of the rasterizer's passes, shared by the views of all image sizes."""

from __future__ import annotations

import torch

from beamsplat.common.raster.cuda.source import BLOCK, BUCKET, GROUP, Kernels
from beamsplat.common.raster.layout import CHANNELS

_BY_GAUSSIAN = (
    "records", "depth", "sorted_depth", "pair_count", "ordered_count", "pair_end", "first_pair", "order",
    "pose_parts",
)  # fmt: skip
_BYTES_EACH = 48 + 6 * 4 + 8 + 1  # of these, rounded up
_SPARE = 1.25  # capacity of pairs over the number that was needed


class RasterBuffers:
    """Tensors per Gaussian (N) and per pair of a splat and a tile (P), of fixed sizes.

    The contents belong to the view that rendered last: its backward pass must follow before another view
    renders. Pairs beyond the capacity are dropped, the farthest first; `grow` repairs it for later images.
    `generation` changes whenever a tensor is allocated anew.

    Args:
        kernels: the kernels that use the memory.
        pairs: capacity of pairs.
    """

    def __init__(self, kernels: Kernels, pairs: int = 1 << 16) -> None:
        self._kernels = kernels
        self.generation = 0
        self.gaussians = self.pairs = self.groups = self.tiles = 0
        self.most_pairs = torch.zeros(1, dtype=torch.int32, device=kernels.device)
        self._wanted_pairs = -(-pairs // GROUP) * GROUP
        # Graphs never run at the same time: they share their temporary memory.
        self.graph_pool = torch.cuda.graph_pool_handle() if kernels.device.type == "cuda" else None

    def fit(self, gaussians: int, tiles: int) -> None:
        """Allocate memory for `gaussians` columns and images of up to `tiles` tiles where it is missing."""
        if gaussians != self.gaussians:
            self._allocate_gaussians(gaussians)
        if self._wanted_pairs != self.pairs:
            self._allocate_pairs(self._wanted_pairs)
        groups = self.pairs // GROUP + max(tiles, self.tiles)
        if groups != self.groups:
            self.groups, self.tiles = groups, max(tiles, self.tiles)
            self.states = self._zeros(groups * (GROUP // BUCKET), CHANNELS, self._kernels.source.tile**2)
            self.generation += 1

    def _zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.zeros(shape, dtype=dtype, device=self._kernels.device)

    def _allocate_gaussians(self, n: int) -> None:
        self.gaussians = n
        self.generation += 1
        self.records = self._zeros(n, 12)
        self.depth, self.sorted_depth = self._zeros(n), self._zeros(n)
        self.pair_count, self.ordered_count, self.pair_end, self.first_pair = (
            self._zeros(n, dtype=torch.int32) for _ in range(4)
        )
        self.order = self._zeros(n, dtype=torch.int64)
        self.pose_parts = self._zeros(n // BLOCK, 6)

    def _allocate_pairs(self, p: int) -> None:
        self.pairs = p
        self.generation += 1
        self.pair_tile, self.sorted_tile = (self._zeros(p, dtype=torch.int16) for _ in range(2))
        self.pair_gaussian = self._zeros(p, dtype=torch.int32)
        self.sorted_pair = self._zeros(p, dtype=torch.int64)
        self.slots = self._zeros(p, 12)

    def grow(self) -> bool:
        """Enlarge the capacity of pairs if an image since the last call needed more; return whether it did.

        Waits for the device: call it once per keyframe, not per image.
        """
        most = int(self.most_pairs)
        self.most_pairs.zero_()
        if most <= self.pairs:
            return False
        self._wanted_pairs = -(-int(_SPARE * most) // GROUP) * GROUP
        self.fit(self.gaussians, self.tiles)
        return True

    def release_tiles(self, tiles: int) -> None:
        """Free what images of more than `tiles` tiles have needed; they allocate it again."""
        if self.tiles > tiles:
            self.tiles = tiles
            self.fit(self.gaussians, tiles)

    @property
    def bytes_each(self) -> int:
        """Memory per Gaussian, bytes."""
        if not self.gaussians:
            return _BYTES_EACH
        arrays = (getattr(self, name) for name in _BY_GAUSSIAN)
        return -(-sum(array.nbytes for array in arrays) // self.gaussians)

    @property
    def allocated_bytes(self) -> int:
        """Memory of all tensors, bytes."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, torch.Tensor))
