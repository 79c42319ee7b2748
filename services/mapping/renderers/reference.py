"""`reference`: the rasterizer in plain torch, for any dtype. Slow; tests compare the other renderers with it.

Dense over the pixels in blocks of 16 x 16, gradients by autograd. Constants are in `raster.layout`.
"""

from __future__ import annotations

import numpy as np
import torch

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import ALPHA_MAX, ALPHA_MIN, BLUR_PX2, MIN_TRANSMITTANCE, NEAR_M
from beamsplat.services.mapping.renderers.protocol import Gaussians, RenderedImage

_BLOCK = 16  # px


class ReferenceRenderer:
    """The rasterizer in plain torch, the reference for the other renderers."""

    def render(
        self,
        gaussians: Gaussians,
        camera: RasterCamera,
        T_camera_map: np.ndarray,
        background: torch.Tensor | None = None,
        pose_tangent: torch.Tensor | None = None,
    ) -> RenderedImage:
        """Render the Gaussians; differentiable in all inputs, also twice."""
        mean = gaussians.mean_map_m
        T = torch.as_tensor(T_camera_map, dtype=mean.dtype)
        R, t = T[:3, :3], T[:3, 3]
        if pose_tangent is not None:
            turn = _so3_exp(pose_tangent[3:])
            R, t = turn @ R, turn @ t + pose_tangent[:3]
        centre, cov, z, keep = _project(gaussians, camera, R, t)
        order = torch.argsort(z, stable=True)
        opacity = torch.sigmoid(gaussians.opacity_logit[keep][order])
        splats = (centre[order], torch.linalg.inv(cov[order]), opacity,
                  torch.cat([gaussians.colour[keep], z[:, None]], dim=1)[order])  # fmt: skip
        reach = 3.34 * torch.linalg.eigvalsh(cov.detach()[order])[:, 1].sqrt() + 1.0
        rows = []
        for top in range(0, camera.height_px, _BLOCK):
            blocks = [_block(splats, reach, camera, left, top) for left in range(0, camera.width_px, _BLOCK)]
            rows.append(torch.cat(blocks, dim=1))
        image = torch.cat(rows, dim=0)
        colour, depth, alpha = image[..., :3], image[..., 3], image[..., 4]
        if background is not None:
            colour = colour + (1.0 - alpha[..., None]) * background.to(mean.dtype)
        return RenderedImage(colour, depth, alpha)


def _so3_exp(phi: torch.Tensor) -> torch.Tensor:
    """Return the rotation matrix [3, 3] of a rotation vector [3] (rad) to second order, exact at zero."""
    zero = torch.zeros_like(phi[0])
    W = torch.stack([
        torch.stack([zero, -phi[2], phi[1]]), torch.stack([phi[2], zero, -phi[0]]),
        torch.stack([-phi[1], phi[0], zero]),
    ])  # fmt: skip
    return torch.eye(3, dtype=phi.dtype) + W + 0.5 * W @ W


def _rotations(quat_wxyz: torch.Tensor) -> torch.Tensor:
    w, x, y, z = torch.nn.functional.normalize(quat_wxyz, dim=1).unbind(1)
    return torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], dim=1).reshape(-1, 3, 3)  # fmt: skip


def _project(
    gaussians: Gaussians, camera: RasterCamera, R: torch.Tensor, t: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Project Gaussians into the image, for the camera pose R [3, 3], t [3] of T_camera_map.

    Returns:
        Centres [V, 2] (px), covariances [V, 2, 2] (px^2), optical z [V] (m) and indices [V] of the V
        Gaussians in front of the camera.
    """
    points = gaussians.mean_map_m @ R.T + t
    keep = torch.nonzero(points[:, 2] > NEAR_M)[:, 0]
    points = points[keep]
    x, y, z = points.unbind(1)
    low_x, high_x, low_y, high_y = camera.slope_limits()
    ux, uy = (x / z).clamp(low_x, high_x), (y / z).clamp(low_y, high_y)
    zero = torch.zeros_like(z)
    J = torch.stack([
        torch.stack([camera.fx_px / z, zero, -camera.fx_px * ux / z], dim=1),
        torch.stack([zero, camera.fy_px / z, -camera.fy_px * uy / z], dim=1),
    ], dim=1)  # fmt: skip
    V = J @ R @ _rotations(gaussians.quat_wxyz[keep]) * gaussians.log_scale[keep].exp()[:, None, :]
    cov = V @ V.transpose(1, 2) + BLUR_PX2 * torch.eye(2, dtype=z.dtype)
    centre = torch.stack([camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px], dim=1)
    return centre, cov, z, keep


def _block(
    splats: tuple[torch.Tensor, ...], reach: torch.Tensor, camera: RasterCamera, left: int, top: int
) -> torch.Tensor:
    """Render one block of pixels with its corner at (left, top): [h, w, 5], r, g, b, depth sum, alpha."""
    centre, conic, opacity, values = splats
    w, h = min(_BLOCK, camera.width_px - left), min(_BLOCK, camera.height_px - top)
    u, v = centre.detach().unbind(1)
    near = torch.nonzero(
        (u + reach > left - 1) & (u - reach < left + w) & (v + reach > top - 1) & (v - reach < top + h)
    )[:, 0]
    rows, columns = torch.meshgrid(torch.arange(top, top + h), torch.arange(left, left + w), indexing="ij")
    pixels = torch.stack([columns.reshape(-1), rows.reshape(-1)], dim=1).to(centre.dtype)
    d = pixels[:, None] - centre[near][None]  # [P, V, 2]
    K = conic[near]
    sigma = (
        0.5 * (K[:, 0, 0] * d[..., 0] ** 2 + K[:, 1, 1] * d[..., 1] ** 2) + K[:, 0, 1] * d[..., 0] * d[..., 1]
    )
    alpha = (opacity[near] * torch.exp(-sigma)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    through = torch.cumprod(1.0 - alpha, dim=1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
    weight = torch.where(through > MIN_TRANSMITTANCE, before * alpha, 0.0)
    out = torch.cat([weight @ values[near], weight.sum(dim=1, keepdim=True)], dim=1)
    return out.reshape(h, w, 5)
