"""`gsplat`: the CUDA rasterizer. Converts to the conventions of gsplat: pixel centres at halves, viewmats."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from beamsplat.common.errors import UserError
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import BLUR_PX2, NEAR_M
from beamsplat.services.mapping.renderers.protocol import Gaussians, RenderedImage


def fault() -> str | None:
    """Return the reason why gsplat cannot run on this machine, as one sentence; None if it can run."""
    if not torch.cuda.is_available():
        return "torch finds no CUDA device; use renderer = 'cpu'"
    try:
        # Without nvcc the import fails with ImportError, OSError or AttributeError: all mean the same.
        from gsplat import rasterization
        from gsplat.cuda._backend import _C
    except Exception as error:
        return f"gsplat cannot be imported: {error}; `pip install 'beamsplat[gpu]'`, or use renderer = 'cpu'"
    if _C is None or rasterization is None:
        return "gsplat has no compiled kernels and found no CUDA toolkit to build them; use renderer = 'cpu'"
    return None


class GsplatRenderer:
    """The gsplat rasterizer.

    Raises:
        UserError: there is no CUDA device, or gsplat or its kernels are missing.
    """

    def __init__(self, device: str = "cuda") -> None:
        why = fault()
        if why is not None:
            raise UserError(f"renderer gsplat: {why}")
        from gsplat import rasterization

        self._rasterization = rasterization
        self._device = device

    def render(
        self,
        gaussians: Gaussians,
        camera: RasterCamera,
        T_camera_map: np.ndarray,
        background: torch.Tensor | None = None,
        pose_tangent: torch.Tensor | None = None,
    ) -> RenderedImage:
        """Render the Gaussians on the device of this renderer; differentiable once."""
        to: dict[str, Any] = {"device": self._device, "dtype": torch.float32}
        viewmat = torch.as_tensor(T_camera_map, **to)
        if pose_tangent is not None:
            viewmat = _left_perturbed(viewmat, pose_tangent.to(**to))
        K = torch.tensor(
            [
                [camera.fx_px, 0.0, camera.cx_px + 0.5],
                [0.0, camera.fy_px, camera.cy_px + 0.5],
                [0.0, 0.0, 1.0],
            ],
            **to,
        )
        mean, log_scale, quat, logit, colour = (tensor.to(**to) for tensor in gaussians.tensors())
        # The background is added here: gsplat would add it to the depth channel too.
        image, alpha, _ = self._rasterization(
            mean, quat, log_scale.exp(), torch.sigmoid(logit), colour, viewmat[None], K[None],
            camera.width_px, camera.height_px, near_plane=NEAR_M, eps2d=BLUR_PX2, render_mode="RGB+D",
        )  # fmt: skip
        alpha = alpha[0, ..., 0]
        rgb = image[0, ..., :3]
        if background is not None:
            rgb = rgb + (1.0 - alpha[..., None]) * background.to(**to)
        return RenderedImage(rgb, image[0, ..., 3], alpha)


def _left_perturbed(viewmat: torch.Tensor, tangent: torch.Tensor) -> torch.Tensor:
    """Return se3_exp(tangent) @ viewmat [4, 4] to first order; exact value and gradient at tangent = 0."""
    zero = torch.zeros_like(tangent[0])
    x, y, z = tangent[3:]
    rows = [(zero, -z, y, tangent[0]), (z, zero, -x, tangent[1]), (-y, x, zero, tangent[2]), (zero,) * 4]
    generator = torch.stack([torch.stack(row) for row in rows])
    return viewmat + generator @ viewmat
