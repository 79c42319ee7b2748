"""Camera pose by direct alignment of the rendered map to an image (Matsuki et al. 2024).

Coarse to fine. At each pyramid level the map is rendered once at the current pose, and the rendered grey
values and depth are aligned to the image by Gauss-Newton with the analytic Jacobian on SE(3). Optional steps
along the rasterizer's own pose gradient may follow; they use the normal equations as preconditioner.
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
from beamsplat.services.localization.camera.image_pyramid import GREY, GreyLevel, ImagePyramid, downsample_2x
from beamsplat.services.localization.camera.kernels import UNKNOWN_COUNT, normal_equations, select_points
from beamsplat.services.localization.camera.settings import CameraTrackerSettings
from beamsplat.services.localization.camera.splat_map import SplatMap

_DAMPING = 1e-4  # relative to the diagonal: unobservable motions stay at their prediction
_GAIN_PRIOR, _OFFSET_PRIOR = 5.0, 5.0  # information of the prior: exposure changes little between images


@dataclass
class Alignment:
    """Pose and exposure of one image, found by alignment to the map, with measures of their quality."""

    T_camera_map: np.ndarray  # float64 [4, 4]
    points: int = 0  # number of points used at the finest level
    inlier_ratio: float = 0.0  # fraction of these points whose error is below `settings.inlier_error`
    correlation: float = 0.0  # Pearson correlation of rendered and observed grey at the points
    error: float = 1.0  # median absolute grey error
    coverage: float = 0.0  # fraction of the image where the map is opaque
    gain: float = 1.0  # exposure model: observed = gain * rendered + offset
    offset: float = 0.0
    hessian: np.ndarray | None = None  # float64 [D, D] of the free motions, divided by the grey variance
    in_view: np.ndarray | None = None  # int32, ascending: indices of the Gaussians in the frustum


@dataclass
class _Rendered:
    """The map rendered at one camera pose: grey values, depth and opacity of every pixel."""

    grey: np.ndarray  # float32 [H, W]
    z_m: np.ndarray  # float32 [H, W], 0 = unknown
    alpha: np.ndarray  # float32 [H, W]
    index: np.ndarray  # int32: Gaussians in the frustum


class Aligner:
    """Aligns images to a splat map. Its buffers are reused: use one object in one thread only."""

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
        self._points = np.zeros((settings.max_points, 4), np.float32)
        self._residuals = np.zeros(settings.max_points, np.float32)

    def align(self, splats: SplatMap, pyramid: ImagePyramid, start: Alignment) -> Alignment:
        """Return the alignment of the image, starting at the pose, gain and offset of `start`."""
        s, found = self.settings, Alignment(start.T_camera_map, gain=start.gain, offset=start.offset)
        # Coarse levels: one render at half size is downsampled for all smaller levels.
        rendered = self._render(splats, found.T_camera_map, 1)
        views = [rendered]
        for _ in range(1, len(s.coarse_steps)):
            last = views[-1]
            grey, z_m, alpha = (downsample_2x(a) for a in (last.grey, last.z_m, last.alpha))
            views.append(_Rendered(grey, z_m, alpha, last.index))
        T_start = found.T_camera_map
        for back, steps in enumerate(s.coarse_steps):
            level = len(s.coarse_steps) - back
            self._gauss_newton(views[level - 1], pyramid.levels[level], level, T_start, steps, found)
        rendered = self._render(splats, found.T_camera_map, 0)
        found.coverage = float((rendered.alpha > s.min_alpha).mean())
        found.in_view = rendered.index
        self._gauss_newton(rendered, pyramid.levels[0], 0, found.T_camera_map, s.fine_steps, found)
        for _ in range(s.rasterizer_steps):
            self._rasterizer_step(splats, pyramid.levels[0], found)
        # Re-orthonormalise: poses are inverted by transposition and extrapolated, so rounding errors grow.
        R = matrix_from_quat_wxyz(quat_wxyz_from_matrix(found.T_camera_map[:3, :3]))
        found.T_camera_map = make_transform(R, found.T_camera_map[:3, 3])
        return found

    def to_body(self, covariance: np.ndarray) -> np.ndarray:
        """Convert a covariance of the camera motion to the covariance of (x, y, yaw) in the body frame.

        Args:
            covariance: float64 [D, D] of the D free motions, as columns of `motion_basis`.

        Returns:
            float64 [3, 3], in m^2, m rad and rad^2.
        """
        R, t = self._T_body_camera[:3, :3], self._T_body_camera[:3, 3]
        adjoint = np.block([[R, skew(t) @ R], [np.zeros((3, 3)), R]])
        to_body = (adjoint @ self._basis)[[0, 1, 5]]
        return to_body @ covariance @ to_body.T

    def _render(self, splats: SplatMap, T_camera_map: np.ndarray, level: int) -> _Rendered:
        image, index = splats.view(self.cameras[level], T_camera_map)
        alpha = image[4]
        # Normalise by alpha, so that small gaps between Gaussians do not look like texture.
        grey = np.tensordot(GREY, image[:3], axes=1) / np.maximum(alpha, 0.3)
        z = np.where(alpha > 0.3, image[3] / np.maximum(alpha, 0.3), 0.0).astype(np.float32)
        return _Rendered(grey, z, alpha, index)

    def _gauss_newton(
        self, rendered: _Rendered, target: GreyLevel, level: int, T_render_map: np.ndarray, steps: int,
        found: Alignment,
    ) -> None:  # fmt: skip
        """Refine pose, gain and offset of `found` in place by Gauss-Newton at one pyramid level.

        `rendered` is the map at the pose `T_render_map`, `target` the image at this level; at most `steps`
        steps are done.
        """
        s, camera = self.settings, self.cameras[level]
        count = self._select_points(rendered)
        T_now_render = found.T_camera_map @ inverse(T_render_map)
        K = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px])
        H, g = np.zeros((UNKNOWN_COUNT, UNKNOWN_COUNT)), np.zeros(UNKNOWN_COUNT)
        delta = 0.05
        free = self._basis.shape[1]
        for step in range(steps + 1):
            used, _ = normal_equations(
                self._points, count, K, T_now_render[:3, :3].copy(), T_now_render[:3, 3].copy(), target.grey,
                target.gradient_x, target.gradient_y, found.gain, found.offset, delta, H, g, self._residuals,
            )  # fmt: skip
            if used < 6:
                break
            residuals = np.abs(self._residuals[:count])
            residuals = residuals[np.isfinite(residuals)]
            error = float(np.median(residuals))
            found.points, found.error = used, error
            found.inlier_ratio = float((residuals < s.inlier_error).mean())
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
        """Return the Pearson correlation of rendered and observed grey values at the first `count` points.

        A low correlation reveals a solution with a gain near zero, whose residuals are small as well.
        """
        residuals = self._residuals[:count].astype(np.float64)
        inside = np.isfinite(residuals)
        shown = self._points[:count, 3][inside].astype(np.float64)
        seen = residuals[inside] + found.gain * shown + found.offset
        if len(shown) < 6 or shown.std() < 1e-6 or seen.std() < 1e-6:
            return 0.0
        return float(np.corrcoef(shown, seen)[0, 1])

    def _reduced(self, H: np.ndarray, g: np.ndarray, found: Alignment) -> tuple[np.ndarray, np.ndarray]:
        """Reduce the normal equations to the D free motions, the log gain and the offset.

        Args:
            H, g: float64 [8, 8] and [8], see `kernels.normal_equations`.
            found: its gain and offset are the point of linearisation of the exposure prior.

        Returns:
            Matrix [D + 2, D + 2] and gradient [D + 2], with exposure prior and damping.
        """
        B = np.zeros((UNKNOWN_COUNT, self._basis.shape[1] + 2))
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

    def _rasterizer_step(self, splats: SplatMap, target: GreyLevel, found: Alignment) -> None:
        """Update the pose of `found` by one Newton step with the gradient from `rasterizer_gradient`."""
        s = self.settings
        gradient, used = rasterizer_gradient(splats, self.cameras[0], target, found, s)
        if used < s.min_points or found.hessian is None:
            return
        variance = max(1.4826 * found.error, 0.004) ** 2
        free = self._basis.shape[1]
        # The normal equations cover the selected points, the gradient all used pixels: rescale.
        H = found.hessian * variance * (used / max(found.points, 1)) + 1e-9 * np.eye(free)
        move = -np.linalg.solve(H, self._basis.T @ gradient)
        found.T_camera_map = se3_exp(self._basis @ np.clip(move, -0.02, 0.02)) @ found.T_camera_map

    def _select_points(self, rendered: _Rendered) -> int:
        """Select points of a render into `self._points`, as many as fit; return their number."""
        s, stride = self.settings, 1
        while True:
            count, found = select_points(
                rendered.grey, rendered.z_m, rendered.alpha, np.float32(s.min_gradient),
                np.float32(s.min_alpha), stride, self._points,
            )  # fmt: skip
            if found // stride <= len(self._points):
                return count
            stride = -(-found // len(self._points))


def rasterizer_gradient(
    splats: SplatMap, camera: RasterCamera, target: GreyLevel, found: Alignment,
    settings: CameraTrackerSettings,
) -> tuple[np.ndarray, int]:  # fmt: skip
    """Return the gradient dL/dxi float [6] of the pose in `found`, and the number of pixels used.

    xi = (rho, phi) perturbs the pose from the left: T_camera_map <- se3_exp(xi) T_camera_map. L is the Huber
    loss of the grey error, summed over the pixels of `target` that the map covers and that have contrast. It
    is differentiated by the backward pass of the rasterizer.
    """
    dx, dy = target.gradient_x, target.gradient_y
    delta, used = np.float32(max(1.345 * 1.4826 * found.error, 0.008)), 0

    def loss(image: np.ndarray, gradient: np.ndarray) -> float:
        nonlocal used
        alpha = np.maximum(image[4], 0.3)
        grey = np.tensordot(GREY, image[:3], axes=1) / alpha
        error = found.gain * grey + found.offset - target.grey
        use = (image[4] > settings.min_alpha) & (dx * dx + dy * dy > settings.min_gradient**2)
        slope = np.where(use, np.clip(error, -delta, delta), 0.0).astype(np.float32)
        gradient[:3] = np.float32(found.gain) * GREY[:, None, None] * slope / alpha
        gradient[3] = 0.0
        gradient[4] = -np.float32(found.gain) * slope * grey / alpha
        used = int(use.sum())
        return float(np.sum(slope * (error - 0.5 * slope)))  # Huber

    _, pose = splats.engine.fit(camera, found.T_camera_map, loss)
    return pose, used


def motion_basis(T_body_camera: np.ndarray, planar: bool) -> np.ndarray:
    """Return a basis [6, D] of the allowed camera motions: D = 6, or D = 3 for planar motion of the body.

    The update is T_camera_map <- exp(xi) T_camera_map. A body that moves on the floor has
    xi = Ad(T_camera_body) (vx, vy, 0, 0, 0, wz).
    """
    if not planar:
        return np.eye(6)
    T = inverse(T_body_camera)
    R, t = T[:3, :3], T[:3, 3]
    adjoint = np.block([[R, skew(t) @ R], [np.zeros((3, 3)), R]])
    return adjoint[:, [0, 1, 5]]
