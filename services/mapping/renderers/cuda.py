"""`cuda`: the CUDA rasterizer of `common/raster/cuda` as a torch autograd function, float32."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.cuda.buffers import RasterBuffers
from beamsplat.common.raster.cuda.driver import CudaKernels
from beamsplat.common.raster.cuda.gaussians import DeviceGaussians
from beamsplat.common.raster.cuda.source import Kernels
from beamsplat.common.raster.cuda.view import RasterView
from beamsplat.common.raster.layout import GROUPS, PARAMS
from beamsplat.services.mapping.renderers.protocol import Gaussians, RenderedImage

_PAIRS_EACH = 4  # room for pairs of splat and tile per Gaussian at the start


class CudaRenderer:
    """The CUDA rasterizer for torch. Each autograd graph has its own memory.

    Args:
        kernels: default: those of the first GPU.

    Raises:
        UserError: the GPU, its driver, torch with CUDA or NVRTC is missing.
    """

    def __init__(self, kernels: Kernels | None = None) -> None:
        self._kernels = kernels or CudaKernels()

    def render(
        self,
        gaussians: Gaussians,
        camera: RasterCamera,
        T_camera_map: np.ndarray,
        background: torch.Tensor | None = None,
        pose_tangent: torch.Tensor | None = None,
    ) -> RenderedImage:
        """Render the Gaussians on the device of the kernels; differentiable once."""
        tangent = torch.zeros(6) if pose_tangent is None else pose_tangent
        image = _RasterizeOnDevice.apply(self._kernels, camera, T_camera_map, tangent, *gaussians.tensors())
        colour = image[:3].permute(1, 2, 0)
        if background is not None:
            colour = colour + (1.0 - image[4, :, :, None]) * background.to(image)
        return RenderedImage(colour, image[3], image[4])


class _RasterizeOnDevice(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        kernels: Kernels,
        camera: RasterCamera,
        T_camera_map: np.ndarray,
        tangent: torch.Tensor,
        *tensors: torch.Tensor,
    ) -> torch.Tensor:
        count = len(tensors[0])
        gaussians = DeviceGaussians(kernels, count)
        gaussians.append(np.zeros((PARAMS, count), np.float32))
        for tensor, (first, last) in zip(tensors, GROUPS.values()):
            gaussians.params[first:last, :count] = (
                tensor.detach().reshape(count, last - first).T.to(kernels.device)
            )
        buffers = RasterBuffers(kernels, max(_PAIRS_EACH * count, 1 << 12))
        view = RasterView(kernels, gaussians, buffers, camera.width_px, camera.height_px, with_rows=True)
        view.set_camera(camera, T_camera_map)
        image = view.forward()
        while buffers.grow():
            image = view.forward()
        ctx.view, ctx.count = view, count
        ctx.like = [torch.empty(0, dtype=t.dtype, device=t.device) for t in (tangent, *tensors)]
        return image.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, d_image: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        view = ctx.view
        view.gradient.copy_(d_image)
        view.backward()
        tangent, *tensors = ctx.like
        out = [
            view.rows[first:last, : ctx.count].T.to(like, copy=True)
            for like, (first, last) in zip(tensors, GROUPS.values())
        ]
        out[3] = out[3].reshape(-1)
        return None, None, None, view.pose_gradient().to(tangent), *out
