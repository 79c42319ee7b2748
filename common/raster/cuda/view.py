"""Forward and backward pass of the rasterizer at one image size: fixed buffers and the order of the launches.

Nothing here waits for the device, and every result is written to a tensor that stays: a CUDA graph can record
it.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import torch

from beamsplat.common.harmonics.basis import coefficients
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.cuda.buffers import RasterBuffers
from beamsplat.common.raster.cuda.gaussians import DeviceGaussians
from beamsplat.common.raster.cuda.source import BLOCK, EMPTY_TILE, GROUP, Kernels, filled
from beamsplat.common.raster.layout import CHANNELS, GRADIENTS, PARAMS

CAMERA = 24  # values of RasterCamera.packed


def tile_for(width_px: int, height_px: int) -> int:
    """Return the smallest side (px) of the tiles with which an image has few enough tiles for int16.

    Raises:
        ValueError: the image is too large for all of them.
    """
    for tile in (8, 16):
        if -(-width_px // tile) * -(-height_px // tile) < EMPTY_TILE:
            return tile
    raise ValueError(f"images of {width_px}x{height_px} px have too many tiles for the CUDA rasterizer")


class RasterView:
    """Renders the Gaussians at one image size, with gradients.

    Args:
        kernels: on the device of the other arguments.
        gaussians: what is rendered.
        buffers: working memory; its contents belong to the view that rendered last.
        width_px, height_px: size of the image.
        with_rows: write the gradients of all parameters to `rows`.

    Attributes:
        camera: float32 [24], see `set_camera`.
        image: float32 [5, H, W]: red, green, blue, accumulated depth (m), alpha; the result of `forward`.
        gradient: float32 [5, H, W], dL/d(image), the input of `backward`.
        rows: float32 [16, capacity], gradients with the rows of `raster.layout`; None if not wanted.
        rates: float32 [17], learning rate of each parameter row, weight and log ratio of the isotropy term,
            learning rate of harmonics.
    """

    def __init__(
        self, kernels: Kernels, gaussians: DeviceGaussians, buffers: RasterBuffers,
        width_px: int, height_px: int, with_rows: bool = False,
    ) -> None:  # fmt: skip
        tile = kernels.source.tile
        self.width_px, self.height_px = width_px, height_px
        self.tiles_x = -(-width_px // tile)
        self.tiles = self.tiles_x * -(-height_px // tile)
        if self.tiles >= EMPTY_TILE:
            raise ValueError(f"{width_px}x{height_px} px are too many for tiles of {tile} px")
        self._kernels, self._gaussians, self._buffers = kernels, gaussians, buffers
        self._with_rows = with_rows
        self.rows: torch.Tensor | None = None
        self.camera, self.rates = self._zeros(CAMERA), self._zeros(PARAMS + 3)
        self.image = self._zeros(CHANNELS, height_px, width_px)
        self.gradient = self._zeros(CHANNELS, height_px, width_px)
        self._tile_used = self._zeros(self.tiles, dtype=torch.int32)
        self._tile_start, self._group_start = (
            self._zeros(self.tiles + 1, dtype=torch.int32) for _ in range(2)
        )
        self._edges = torch.arange(self.tiles + 1, dtype=torch.int16, device=kernels.device)
        self._arguments: ctypes.Structure | None = None
        self._prepared_for: tuple[int, int] | None = None

    def _zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.zeros(shape, dtype=dtype, device=self._kernels.device)

    def prepare(self) -> tuple[int, int]:
        """Fit the working memory to the Gaussians; return the generations of both.

        Launches recorded for other generations use freed memory.
        """
        gaussians, buffers = self._gaussians, self._buffers
        buffers.fit(gaussians.capacity, self.tiles)
        generations = (gaussians.generation, buffers.generation)
        if self._prepared_for != generations:
            if self._with_rows:
                self.rows = self._zeros(GRADIENTS, gaussians.capacity)
            self._arguments = filled(self._kernels.source.structures["RasterArguments"], **self._values())
            self._prepared_for = generations
        return generations

    def _values(self) -> dict[str, Any]:
        g, b = self._gaussians, self._buffers
        shared = (
            "records", "depth", "pair_count", "first_pair", "order", "pair_end", "most_pairs", "pair_tile",
            "pair_gaussian", "sorted_pair", "states", "slots", "pose_parts", "pairs", "groups",
        )  # fmt: skip
        return {
            **{name: getattr(b, name) for name in shared},
            "harmonics": g.harmonics, "harmonics_first": g.harmonics_first,
            "harmonics_second": g.harmonics_second, "shown": g.shown, "turned": g.turned,
            "harmonic_terms": coefficients(g.degree),
            "params": g.params, "first": g.first, "second": g.second, "steps": g.steps,
            "count": g.count_on_device, "stride": g.capacity, "camera": self.camera, "rates": self.rates,
            "tile_start": self._tile_start, "group_start": self._group_start, "tile_used": self._tile_used,
            "image": self.image, "gradient": self.gradient, "rows": self.rows,
            "width": self.width_px, "height": self.height_px, "tiles_x": self.tiles_x, "tiles": self.tiles,
        }  # fmt: skip

    def set_camera(self, camera: RasterCamera, T_camera_map: np.ndarray) -> None:
        """Set intrinsics and pose of the next images.

        Raises:
            ValueError: the camera has another image size, or the pose is not finite.
        """
        if (camera.width_px, camera.height_px) != (self.width_px, self.height_px):
            raise ValueError(f"the camera is not of {self.width_px}x{self.height_px} px: {camera}")
        self.camera.copy_(torch.from_numpy(camera.packed(T_camera_map)))

    def set_rates(
        self, rates: np.ndarray, isotropy: float = 0.0, ratio_log: float = 0.0, harmonics: float = 0.0
    ) -> None:
        """Set learning rates [14] and isotropy term of `backward(learn=True)`, see `optimiser.adam`.

        `harmonics` is the learning rate of spherical harmonics.
        """
        values = np.append(rates, (isotropy, ratio_log, harmonics)).astype(np.float32)
        self.rates.copy_(torch.from_numpy(values))

    def forward(self) -> torch.Tensor:
        """Render the Gaussians with `camera`; return `image`."""
        b, launch, arguments = self._buffers, self._kernels.launch, self._ready()
        blocks = b.gaussians // BLOCK
        if self._gaussians.degree:
            launch("shade", blocks, arguments)
        launch("project", blocks, arguments)
        torch.sort(b.depth, stable=True, out=(b.sorted_depth, b.order))
        torch.index_select(b.pair_count, 0, b.order, out=b.ordered_count)
        torch.cumsum(b.ordered_count, 0, dtype=torch.int32, out=b.pair_end)
        b.pair_tile.fill_(EMPTY_TILE)
        launch("emit", blocks, arguments)
        torch.sort(b.pair_tile, stable=True, out=(b.sorted_tile, b.sorted_pair))
        torch.searchsorted(b.sorted_tile, self._edges, out_int32=True, out=self._tile_start)
        groups = (torch.diff(self._tile_start) + (GROUP - 1)) // GROUP
        torch.cumsum(groups, 0, dtype=torch.int32, out=self._group_start[1:])
        launch("forward", self.tiles, arguments)
        return self.image

    def backward(self, learn: bool = False) -> None:
        """Compute the gradients of the last image from `gradient`: `rows`, and parts of the pose gradient.

        Args:
            learn: take a step of Adam on the visible Gaussians, with `rates`.
        """
        arguments = self._ready()
        arguments.learn = int(learn)
        self._kernels.launch("backward", self._buffers.groups, arguments)
        if self._gaussians.degree:
            self._kernels.launch("shade_backward", self._buffers.gaussians // BLOCK, arguments)
        self._kernels.launch("chain", self._buffers.gaussians // BLOCK, arguments)

    def pose_gradient(self) -> torch.Tensor:
        """Return dL/d(rho, phi) float64 [6] of the last backward pass, left perturbation of T_camera_map."""
        return torch.sum(self._buffers.pose_parts, 0, dtype=torch.float64)

    def _ready(self) -> Any:
        self.prepare()
        return self._arguments

    @property
    def allocated_bytes(self) -> int:
        """Memory of this view's own tensors, bytes."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, torch.Tensor))
