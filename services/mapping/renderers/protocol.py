"""The interface of the differentiable renderers, on torch tensors with autograd.

Gaussians are five tensors of one dtype: mean_map_m [N, 3], log_scale [N, 3] (ln metres), quat_wxyz
[N, 4] (any norm but zero), opacity_logit [N], colour [N, 3]. The pose enters as `T_camera_map` and, for its
gradient, as a tangent xi [6] = (rho, phi): the camera pose is se3_exp(xi) @ T_camera_map.
`xi` must be zero: renderers may linearise there.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from beamsplat.common.errors import UserError
from beamsplat.common.raster.camera import RasterCamera


@dataclass(frozen=True)
class Gaussians:
    """The parameters of Gaussians as tensors."""

    mean_map_m: torch.Tensor  # [N, 3]
    log_scale: torch.Tensor  # [N, 3]
    quat_wxyz: torch.Tensor  # [N, 4]
    opacity_logit: torch.Tensor  # [N]
    colour: torch.Tensor  # [N, 3]

    def tensors(self) -> tuple[torch.Tensor, ...]:
        """Return the five tensors, in the order of the rows of the rasterizer's parameter array."""
        return self.mean_map_m, self.log_scale, self.quat_wxyz, self.opacity_logit, self.colour


@dataclass(frozen=True)
class RenderedImage:
    """A rendered image: colour, accumulated depth and alpha."""

    colour: torch.Tensor  # [H, W, 3]
    depth_m: torch.Tensor  # [H, W]: accumulated depth, sum of weight times optical z
    alpha: torch.Tensor  # [H, W]

    def expected_depth_m(self) -> torch.Tensor:
        """Return the expected depth [H, W] (m): accumulated depth / alpha; NaN where alpha is below 1e-3."""
        known = self.alpha > 1e-3
        return torch.where(known, self.depth_m / torch.where(known, self.alpha, 1.0), torch.nan)


class DifferentiableRenderer(Protocol):
    """A differentiable rasterizer."""

    def render(
        self,
        gaussians: Gaussians,
        camera: RasterCamera,
        T_camera_map: np.ndarray,  # float64 [4, 4]
        background: torch.Tensor | None = None,  # [3], default black
        pose_tangent: torch.Tensor
        | None = None,  # [6], zero, with requires_grad where its gradient is wanted
    ) -> RenderedImage:
        """Render the Gaussians at the camera pose `T_camera_map`."""
        ...


RENDERERS: dict[str, str] = {
    "reference": "beamsplat.services.mapping.renderers.reference:ReferenceRenderer",
    "cpu": "beamsplat.services.mapping.renderers.cpu:CpuRenderer",
    "cuda": "beamsplat.services.mapping.renderers.cuda:CudaRenderer",
}


def make_renderer(name: str) -> DifferentiableRenderer:
    """Create the renderer with a name in `RENDERERS`; its module is imported on the first call.

    Raises:
        UserError: the name is unknown, or this machine cannot run the renderer.
    """
    if name not in RENDERERS:
        raise UserError(f"unknown renderer {name!r}; choose one of {', '.join(RENDERERS)}")
    module, _, cls = RENDERERS[name].partition(":")
    return getattr(importlib.import_module(module), cls)()
