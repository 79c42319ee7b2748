"""Where the camera is: the pose at which the map, rendered, looks like the picture (Matsuki et al. 2024).

Coarse to fine. At each size the map is rendered once at the pose so far, and the rendered view, colour and
depth, is aligned to the picture by Gauss-Newton with the analytic Jacobian on SE(3). Steps with the gradient
of the rasterizer itself may follow; the normal equations then serve as preconditioner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.transforms import (
    inverse,
    make_transform,
    matrix_from_quat_wxyz,
    quat_wxyz_from_matrix,
    se3_exp,
    skew,
)
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.localization.camera.kernels import UNKNOWNS, choose_points, normal_equations
from beamsplat.services.localization.camera.settings import CameraTrackerSettings
from beamsplat.services.localization.camera.splat_map import SplatMap
from beamsplat.services.localization.camera.view import GREY, GreyLevel, PictureView, halved

_DAMPING = 1e-4  # of the diagonal: keeps what the picture does not tell where it was predicted
_GAIN_PRIOR, _OFFSET_PRIOR = 5.0, 5.0  # exposure changes little between pictures


@dataclass
class Alignment:
    """The answer for one picture, and what speaks for it."""

    T_camera_map: np.ndarray
    points: int = 0  # used at the finest level
    inliers: float = 0.0  # share of them within the error that counts as seen
    correlation: float = 0.0  # of the rendered grey with the picture's at the points
    error: float = 1.0  # median |grey error|
    explained: float = 0.0  # share of the picture where the map is opaque
    gain: float = 1.0
    offset: float = 0.0
    hessian: np.ndarray | None = None  # [D, D] of the degrees of freedom, over the variance of the grey
    in_view: np.ndarray | None = None  # int32: Gaussians that may be seen, ascending


@dataclass
class _Rendered:
    """The map as seen from a pose."""

    grey: np.ndarray  # float32 [H, W]
    z_m: np.ndarray  # float32 [H, W], 0 where unknown
    alpha: np.ndarray  # float32 [H, W]
    index: np.ndarray


class Aligner:
    """Scratch memory and settings of `align`."""

    def __init__(
        self, camera: RasterCamera, T_body_camera: np.ndarray, settings: CameraTrackerSettings
    ) -> None:
        self.settings = settings
        self.cameras = [camera]
        for _ in range(len(settings.coarse_steps)):
            last = self.cameras[-1]
            self.cameras.append(last.resized(last.width_px // 2, last.height_px // 2))
        self._T_body_camera = T_body_camera
        self._basis = motion_basis(T_body_camera, settings.planar)  # [6, D]
        self._points = np.zeros((settings.most_points, 4), np.float32)
        self._residuals = np.zeros(settings.most_points, np.float32)

    def align(self, splats: SplatMap, picture: PictureView, start: Alignment) -> Alignment:
        """Aligns the picture, beginning at `start` (its pose, gain and offset)."""
        s, found = self.settings, Alignment(start.T_camera_map, gain=start.gain, offset=start.offset)
        # Coarse: one render at the second level serves all that are smaller.
        rendered = self._render(splats, found.T_camera_map, 1)
        views = [rendered]
        for _ in range(1, len(s.coarse_steps)):
            last = views[-1]
            views.append(_Rendered(*(halved(a) for a in (last.grey, last.z_m, last.alpha)), last.index))
        T_start = found.T_camera_map
        for back, steps in enumerate(s.coarse_steps):
            level = len(s.coarse_steps) - back
            self._gauss_newton(views[level - 1], picture.levels[level], level, T_start, steps, found)
        rendered = self._render(splats, found.T_camera_map, 0)
        found.explained = float((rendered.alpha > s.least_alpha).mean())
        found.in_view = rendered.index
        self._gauss_newton(rendered, picture.levels[0], 0, found.T_camera_map, s.fine_steps, found)
        for _ in range(s.exact_steps):
            self._exact_step(splats, picture.levels[0], found)
        # Rounding grows from picture to picture where poses are inverted by transposition and extrapolated.
        R = matrix_from_quat_wxyz(quat_wxyz_from_matrix(found.T_camera_map[:3, :3]))
        found.T_camera_map = make_transform(R, found.T_camera_map[:3, 3])
        return found

    def to_body(self, covariance: np.ndarray) -> np.ndarray:
        """float64 [3, 3] of the body's motion (x, y, yaw) in its own frame, from that of the free motions."""
        R, t = self._T_body_camera[:3, :3], self._T_body_camera[:3, 3]
        adjoint = np.block([[R, skew(t) @ R], [np.zeros((3, 3)), R]])
        to_body = (adjoint @ self._basis)[[0, 1, 5]]
        return to_body @ covariance @ to_body.T

    def _render(self, splats: SplatMap, T_camera_map: np.ndarray, level: int) -> _Rendered:
        render = splats.render(self.cameras[level], T_camera_map)
        alpha = render.image[4].copy()
        # Where little light comes through the gaps, it is the surface's: else gaps would look like texture.
        grey = np.tensordot(GREY, render.image[:3], axes=1) / np.maximum(alpha, 0.3)
        z = np.where(alpha > 0.3, render.image[3] / np.maximum(alpha, 0.3), 0.0).astype(np.float32)
        index = render.index.copy()
        splats.release(render)
        return _Rendered(grey, z, alpha, index)

    def _gauss_newton(
        self, rendered: _Rendered, target: GreyLevel, level: int, T_render_map: np.ndarray, steps: int,
        found: Alignment,
    ) -> None:  # fmt: skip
        """Improves `found` at one level; its pose is that of the picture."""
        s, camera = self.settings, self.cameras[level]
        count = self._choose(rendered)
        T_now_render = found.T_camera_map @ inverse(T_render_map)
        K = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px])
        H, g = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
        delta = 0.05
        free = self._basis.shape[1]
        for step in range(steps + 1):
            used, _ = normal_equations(
                self._points, count, K, T_now_render[:3, :3].copy(), T_now_render[:3, 3].copy(), target.grey,
                target.slope_x, target.slope_y, found.gain, found.offset, delta, H, g, self._residuals,
            )  # fmt: skip
            if used < 6:
                break
            residuals = np.abs(self._residuals[:count])
            residuals = residuals[np.isfinite(residuals)]
            error = float(np.median(residuals))
            found.points, found.error = used, error
            found.inliers = float((residuals < s.inlier_error).mean())
            delta = max(1.345 * 1.4826 * error, 0.008)
            A, b = self._reduced(H, g, found)
            found.hessian = A[:free, :free] / max(1.4826 * error, 0.004) ** 2
            if step == steps:
                break
            move = -np.linalg.solve(A, b)
            T_now_render = se3_exp(self._basis @ move[:free]) @ T_now_render
            found.gain *= float(np.exp(np.clip(move[free], -0.2, 0.2)))
            found.offset += float(np.clip(move[free + 1], -0.1, 0.1))
            if np.abs(move[:free]).max() < 1e-4:
                break
        found.T_camera_map = T_now_render @ T_render_map
        found.correlation = self._correlation(count, found)

    def _correlation(self, count: int, found: Alignment) -> float:
        """A gain near zero would make anything look alike: this does not fall for it."""
        residuals = self._residuals[:count].astype(np.float64)
        inside = np.isfinite(residuals)
        shown = self._points[:count, 3][inside].astype(np.float64)
        seen = residuals[inside] + found.gain * shown + found.offset
        if len(shown) < 6 or shown.std() < 1e-6 or seen.std() < 1e-6:
            return 0.0
        return float(np.corrcoef(shown, seen)[0, 1])

    def _reduced(self, H: np.ndarray, g: np.ndarray, found: Alignment) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations of the free motions and of exposure, with priors and damping."""
        B = np.zeros((UNKNOWNS, self._basis.shape[1] + 2))
        B[:6, :-2] = self._basis
        B[6, -2] = B[7, -1] = 1.0
        A, b = B.T @ H @ B, B.T @ g
        A[-2, -2] += _GAIN_PRIOR
        A[-1, -1] += _OFFSET_PRIOR
        b[-2] += _GAIN_PRIOR * np.log(found.gain)
        b[-1] += _OFFSET_PRIOR * found.offset
        A[np.diag_indices_from(A)] *= 1.0 + _DAMPING
        A[np.diag_indices_from(A)] += 1e-9
        return A, b

    def _exact_step(self, splats: SplatMap, target: GreyLevel, found: Alignment) -> None:
        """One step down the rasterizer's pose gradient of the same robust loss."""
        s = self.settings
        gradient, used = exact_gradient(splats, self.cameras[0], target, found, s)
        if used < s.least_points or found.hessian is None:
            return
        variance = max(1.4826 * found.error, 0.004) ** 2
        free = self._basis.shape[1]
        # The normal equations hold for the chosen points, the gradient for all pixels used.
        H = found.hessian * variance * (used / max(found.points, 1)) + 1e-9 * np.eye(free)
        move = -np.linalg.solve(H, self._basis.T @ gradient)
        found.T_camera_map = se3_exp(self._basis @ np.clip(move, -0.02, 0.02)) @ found.T_camera_map

    def _choose(self, rendered: _Rendered) -> int:
        """Fills the points; of a picture full of contrast every n-th."""
        s, stride = self.settings, 1
        while True:
            count, found = choose_points(
                rendered.grey, rendered.z_m, rendered.alpha, np.float32(s.least_gradient),
                np.float32(s.least_alpha), stride, self._points,
            )  # fmt: skip
            if found // stride <= len(self._points):
                return count
            stride = -(-found // len(self._points))


def exact_gradient(
    splats: SplatMap, camera: RasterCamera, target: GreyLevel, found: Alignment,
    settings: CameraTrackerSettings,
) -> tuple[np.ndarray, int]:  # fmt: skip
    """dL/dxi [6] of T_camera_map <- se3_exp(xi) T_camera_map through the rasterizer, and the pixels used.

    L is Huber's loss of the grey error over pixels that the map explains and that have contrast.
    """
    render = splats.render(camera, found.T_camera_map)
    alpha = np.maximum(render.image[4], 0.3)
    grey = np.tensordot(GREY, render.image[:3], axes=1) / alpha
    error = found.gain * grey + found.offset - target.grey
    dx, dy = target.slope_x, target.slope_y
    use = (render.image[4] > settings.least_alpha) & (dx * dx + dy * dy > settings.least_gradient**2)
    delta = np.float32(max(1.345 * 1.4826 * found.error, 0.008))
    slope = np.where(use, np.clip(error, -delta, delta), 0.0).astype(np.float32)
    gradient = np.zeros_like(render.image)
    gradient[:3] = np.float32(found.gain) * GREY[:, None, None] * slope / alpha
    gradient[4] = -np.float32(found.gain) * slope * grey / alpha
    pose = splats.rasterizer.backward(render, gradient).pose.copy()
    splats.release(render)
    return pose, int(use.sum())


def motion_basis(T_body_camera: np.ndarray, planar: bool) -> np.ndarray:
    """[6, D] motions of the camera that are allowed: all six, or what a body does that stays on its floor.

    T_camera_map <- exp(xi) T_camera_map moves the map as the camera sees it; a body that drives and turns
    on the floor gives xi = Ad(T_camera_body) (vx, vy, 0, 0, 0, wz).
    """
    if not planar:
        return np.eye(6)
    T = inverse(T_body_camera)
    R, t = T[:3, :3], T[:3, 3]
    adjoint = np.block([[R, skew(t) @ R], [np.zeros((3, 3)), R]])
    return adjoint[:, [0, 1, 5]]
