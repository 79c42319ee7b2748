"""The camera as the kernels see it. The one place where a pose becomes rotation and translation numbers.

Kernels take `T_camera_map` (what gsplat calls viewmat); pixel centres have integer coordinates, as everywhere
in this project (gsplat's are at halves: its adapter adds 0.5 to cx and cy).

The pose gradient is that of the left perturbation: with T_camera_map(xi) = se3_exp(xi) @ T_camera_map, it is
dL/dxi at xi = 0, xi = (rho, phi) in the camera frame, translation first (`geometry.transforms.se3_exp`).
For a perturbation on the other side, T_camera_map @ se3_exp(xi), multiply it by Ad(T_camera_map)^T:
see `right_gradient`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.transforms import skew
from beamsplat.common.raster.layout import NEAR_M


@dataclass(frozen=True)
class RasterCamera:
    """A pinhole of one image size; K belongs to it."""

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
        """The same view at another size; area edges stay, so centres shift by half pixels."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return RasterCamera(
            self.fx_px * sx, self.fy_px * sy, (self.cx_px + 0.5) * sx - 0.5, (self.cy_px + 0.5) * sy - 0.5,
            width_px, height_px,
        )  # fmt: skip

    def slope_limits(self) -> tuple[float, float, float, float]:
        """x/z and y/z (low, high, low, high) beyond which the Jacobian is held: 15 % of a view outside."""
        margin_x, margin_y = 0.15 * self.width_px / self.fx_px, 0.15 * self.height_px / self.fy_px
        return (
            -(self.cx_px + 0.5) / self.fx_px - margin_x,
            (self.width_px - 0.5 - self.cx_px) / self.fx_px + margin_x,
            -(self.cy_px + 0.5) / self.fy_px - margin_y,
            (self.height_px - 0.5 - self.cy_px) / self.fy_px + margin_y,
        )  # fmt: skip

    def packed(self, T_camera_map: np.ndarray) -> np.ndarray:
        """float32 [24] for the kernels: R row by row, t, fx fy cx cy, slope limits, width height near.

        Raises:
            ValueError: the pose is not a finite [4, 4].
        """
        T = np.asarray(T_camera_map, dtype=np.float64)
        if T.shape != (4, 4) or not np.all(np.isfinite(T)):
            raise ValueError(f"T_camera_map must be a finite [4, 4], got {T.tolist()}")
        values = (*T[:3, :3].ravel(), *T[:3, 3], self.fx_px, self.fy_px, self.cx_px, self.cy_px,
                  *self.slope_limits(), self.width_px, self.height_px, NEAR_M, 0.0)  # fmt: skip
        return np.array(values, dtype=np.float32)


def right_gradient(pose_gradient: np.ndarray, T_camera_map: np.ndarray) -> np.ndarray:
    """dL/dxi [6] of T_camera_map @ se3_exp(xi), from that of se3_exp(xi) @ T_camera_map.

    T exp(xi) = exp(Ad(T) xi) T, so the gradient is Ad(T)^T g (Barfoot 2017, eq. 7.63).
    """
    R, t = T_camera_map[:3, :3], T_camera_map[:3, 3]
    adjoint = np.block([[R, skew(t) @ R], [np.zeros((3, 3)), R]])
    return adjoint.T @ np.asarray(pose_gradient, dtype=np.float64)
