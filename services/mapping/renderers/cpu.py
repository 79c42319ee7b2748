"""`cpu`: the Numba rasterizer as a torch autograd function, float32. Each autograd graph has its own
workspace.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import GROUPS, PARAMS
from beamsplat.common.raster.rasterizer import Rasterizer, Render
from beamsplat.services.mapping.renderers.protocol import Gaussians, RenderedImage


class CpuRenderer:
    """The Numba rasterizer for torch. `threads` are shared by all renders of this object."""

    def __init__(self, threads: int = 1) -> None:
        self._rasterizer = Rasterizer(threads)

    def render(
        self,
        gaussians: Gaussians,
        camera: RasterCamera,
        T_camera_map: np.ndarray,
        background: torch.Tensor | None = None,
        pose_tangent: torch.Tensor | None = None,
    ) -> RenderedImage:
        """Render the Gaussians; differentiable once."""
        tangent = torch.zeros(6) if pose_tangent is None else pose_tangent
        black = torch.zeros(3) if background is None else background
        image = _Rasterize.apply(self._rasterizer, camera, T_camera_map, black, tangent, *gaussians.tensors())
        return RenderedImage(image[:3].permute(1, 2, 0), image[3], image[4])


def pack(gaussians: tuple[torch.Tensor, ...]) -> tuple[np.ndarray, int]:
    """Pack Gaussians into the array of the kernels, float32 [14, capacity]; return array and number."""
    count = len(gaussians[0])
    params = np.zeros((PARAMS, -(-max(count, 1) // 16) * 16), np.float32)
    for tensor, (first, last) in zip(gaussians, GROUPS.values()):
        params[first:last, :count] = tensor.detach().reshape(count, last - first).numpy().T
    return params, count


class _RenderLease:
    """Releases the workspace of a render when its autograd graph is freed, with or without backward pass."""

    def __init__(self, rasterizer: Rasterizer, render: Render) -> None:
        self.rasterizer, self.render = rasterizer, render

    def __del__(self) -> None:
        self.rasterizer.release(self.render)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rasterizer: Rasterizer,
        camera: RasterCamera,
        T_camera_map: np.ndarray,
        background: torch.Tensor,
        tangent: torch.Tensor,
        *gaussians: torch.Tensor,
    ) -> torch.Tensor:
        params, count = pack(gaussians)
        render = rasterizer.render(params, count, camera, T_camera_map, background.detach().numpy())
        ctx.lease, ctx.count, ctx.dtypes = (
            _RenderLease(rasterizer, render),
            count,
            [g.dtype for g in gaussians],
        )
        ctx.tangent_dtype = tangent.dtype
        return torch.from_numpy(render.image.copy())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, d_image: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        rasterizer, render = ctx.lease.rasterizer, ctx.lease.render
        gradients = rasterizer.backward(render, np.ascontiguousarray(d_image.numpy()))
        dense = torch.from_numpy(gradients.dense(ctx.count))
        # The background has the remaining transmittance 1 - alpha as weight: its gradient needs no kernel.
        through = 1.0 - torch.from_numpy(render.image[4])
        d_background = (d_image[:3] * through).sum(dim=(1, 2))
        out = [dense[first:last].T.to(dtype) for dtype, (first, last) in zip(ctx.dtypes, GROUPS.values())]
        out[3] = out[3].reshape(-1)
        pose = torch.from_numpy(gradients.pose).to(ctx.tangent_dtype)
        return None, None, None, d_background, pose, *out
