"""The camera of the rasterizer, and its packing for the kernels.

Kernels take `T_camera_map` (gsplat's viewmat). Pixel centres have integer coordinates, as everywhere in this
project; gsplat's are at half-integers, so its adapter adds 0.5 to cx and cy.

The pose gradient refers to a left perturbation: with T_camera_map(xi) = se3_exp(xi) @ T_camera_map, it is
dL/dxi at xi = 0, xi = (rho, phi) in the camera frame, translation first (`geometry.transforms.se3_exp`).
For a right perturbation, T_camera_map @ se3_exp(xi), multiply it by Ad(T_camera_map)^T (Barfoot 2017, eq.
7.63).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.raster.layout import NEAR_M


@dataclass(frozen=True)
class RasterCamera:
    """Pinhole camera without distortion; K is valid for this image size.

    Raises:
        ValueError: a value is not finite, or a focal length or the size is not positive.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int

    def __post_init__(self) -> None:
        values = (self.fx_px, self.fy_px, self.cx_px, self.cy_px)
        if not all(np.isfinite(values)) or min(self.fx_px, self.fy_px, self.width_px, self.height_px) <= 0:
            raise ValueError(f"focal lengths and image size must be positive and finite: {self}")

    def resized(self, width_px: int, height_px: int) -> RasterCamera:
        """Return this camera for another image size, with scaled K; the field of view stays the same."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return RasterCamera(
            self.fx_px * sx, self.fy_px * sy, (self.cx_px + 0.5) * sx - 0.5, (self.cy_px + 0.5) * sy - 0.5,
            width_px, height_px,
        )  # fmt: skip

    def slope_limits(self) -> tuple[float, float, float, float]:
        """Return the limits of x/z (low, high) and y/z (low, high) for the Jacobian of the projection.

        The Jacobian is evaluated at slopes clamped to these limits, 15 % of the image size outside the image,
        as in gsplat.
        """
        margin_x, margin_y = 0.15 * self.width_px / self.fx_px, 0.15 * self.height_px / self.fy_px
        return (
            -(self.cx_px + 0.5) / self.fx_px - margin_x,
            (self.width_px - 0.5 - self.cx_px) / self.fx_px + margin_x,
            -(self.cy_px + 0.5) / self.fy_px - margin_y,
            (self.height_px - 0.5 - self.cy_px) / self.fy_px + margin_y,
        )  # fmt: skip

    def packed(self, T_camera_map: np.ndarray) -> np.ndarray:
        """Return camera and pose `T_camera_map` [4, 4] as one array for the kernels, float32 [24].

        Entries: R by rows (0 to 8), t (9 to 11), fx fy cx cy (12 to 15), slope limits (16 to 19), width,
        height, near plane (20 to 22), 0.

        Raises:
            ValueError: the pose is not a finite [4, 4] matrix.
        """
        T = np.asarray(T_camera_map, dtype=np.float64)
        if T.shape != (4, 4) or not np.all(np.isfinite(T)):
            raise ValueError(f"T_camera_map must be a finite [4, 4], got {T.tolist()}")
        values = (*T[:3, :3].ravel(), *T[:3, 3], self.fx_px, self.fy_px, self.cx_px, self.cy_px,
                  *self.slope_limits(), self.width_px, self.height_px, NEAR_M, 0.0)  # fmt: skip
        return np.array(values, dtype=np.float32)
