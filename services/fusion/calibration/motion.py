"""Time offset and mount of the camera from motion: tracked corners compared with poses from the lidar.

Corners tracked between two images fulfil the epipolar constraint only if the poses of the two image times
and the mount of the camera are correct. Rotation of the robot makes the time offset (by changes of the yaw
rate) and the x, y position of the camera observable; translation makes yaw and pitch observable; rotation and
translation together make roll observable. A robot on a floor does not move vertically, so the height of the
camera is not observable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.transforms import inverse, so3_exp

PARAMETERS = ("clock_s", "roll_rad", "pitch_rad", "yaw_rad", "x_m", "y_m")
_PRIOR = np.array([0.3, 0.1, 0.1, 0.1, 0.03, 0.03])  # standard deviations of the prior, zero mean
# Steps of the numeric derivatives, in the units of PARAMETERS.
_STEP = np.array([1e-3, 1e-5, 1e-5, 1e-5, 1e-4, 1e-4])
_SEARCH_S = 0.32  # largest time offset of the grid search
_TRACK_PX = 0.3  # standard deviation of a corner track
_INVERSE_DEPTH, _INVERSE_DEPTH_SIGMA = 0.35, 0.3  # 1/m, prior of corners in rooms
_BLOCKS = 8  # blocks of a drive, for the jackknife
# Errors common to a whole drive, which the spread between its parts does not show: corner tracks are off by
# 0.03 px in one direction (0.1 degrees of pitch); poses from scans have a delay of up to 4 ms and turn the
# direction of motion by some 0.05 degrees. RMS on simulated drives of seeds 101 to 103 and on house_a;
# verified on other seeds by `bench uncertainties`.
_SYSTEMATIC = np.array([2.5e-3, *np.radians([0.03, 0.08, 0.06]), 0.007, 0.007])
# A parameter with a larger standard error counts as not observable.
OBSERVABLE = np.array([0.025, 0.01, 0.01, 0.01, 0.02, 0.02])


@dataclass(frozen=True)
class TrackedPair:
    """Rays of the corners that were tracked from image a to image b; stamps are on the camera's clock."""

    stamp_a_ns: int
    stamp_b_ns: int
    rays_a: np.ndarray  # float64 [N, 3], z = 1
    rays_b: np.ndarray  # float64 [N, 3]


@dataclass(frozen=True)
class MotionCalibration:
    """Corrections of time offset and mount with standard errors, in order and units of `PARAMETERS`.

    The correction `clock_s` is added to image stamps.
    """

    values: np.ndarray  # float64 [6]
    sigma: np.ndarray  # float64 [6], inf = not estimated
    residual_px: float  # median distance after the correction
    residual_before_px: float
    corners: int  # number of tracks

    @property
    def observable(self) -> np.ndarray:
        """Return bool [6], one per parameter: True if the standard error is below the limit `OBSERVABLE`."""
        return self.sigma < OBSERVABLE

    def mount(self, T_body_camera: np.ndarray) -> np.ndarray:
        """Return `T_body_camera` [4, 4] with the observable corrections of rotation and (x, y) applied."""
        return apply_correction(T_body_camera, np.where(self.observable, self.values, 0.0))


def apply_correction(T_body_camera: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the mount [4, 4], rotated by (roll, pitch, yaw) about the body axes and translated by (x, y).

    `values` float64 [6] in the order of `PARAMETERS`; the time offset `values[0]` is not used.
    """
    T = T_body_camera.copy()
    T[:3, :3] = so3_exp(values[1:4]) @ T_body_camera[:3, :3]
    T[:2, 3] += values[4:6]
    return T


def solve_motion(
    pairs: list[TrackedPair],
    pose_at: Callable[[int], np.ndarray | None],  # stamp_ns on the lidar's clock -> T_map_body
    T_body_camera: np.ndarray,
    focal_px: float,
    free: tuple[str, ...] = PARAMETERS,
    drift_rad_s: float = 0.0,
) -> MotionCalibration:
    """Estimate the corrections of time offset and mount: grid search over the time offset, then Gauss-Newton.

    The result is the maximum a posteriori estimate. Its standard errors combine the spread between blocks of
    the drive (a jackknife, because the errors of the corners of one image are correlated), the width of the
    prior where it determines the value, and the errors that all parts of a drive share. A parameter that is
    not free counts as exact, but the shared errors that act like it change the others.

    Args:
        pairs: image pairs with tracked corners, in order of time.
        pose_at: returns `T_map_body` [4, 4] at a stamp on the lidar's clock; None if there is no pose.
        T_body_camera: the mount to correct.
        focal_px: focal length of the images in which the corners were tracked.
        free: names of the parameters to estimate; the others stay 0.
        drift_rad_s: standard deviation of a constant drift of the yaw of the poses; 0 for poses in a map.

    Raises:
        ValueError: too few pairs with at least 8 corners.
    """
    pairs = [p for p in pairs if len(p.rays_a) >= 8]
    if len(pairs) < 2 * _BLOCKS:
        raise ValueError(f"only {len(pairs)} pairs of images with tracked corners; {2 * _BLOCKS} are needed")
    mask = np.array([name in free for name in PARAMETERS])
    start = np.zeros(len(PARAMETERS))
    problem = _Problem(pairs, pose_at, T_body_camera, focal_px)
    before = problem.residuals(start)
    if mask[0]:
        start[0] = _search_clock(_Problem(pairs[::3], pose_at, T_body_camera, focal_px), mask)
    best = problem.gauss_newton(start, mask, 12)
    sigma = problem.jackknife(best, mask)
    # A value determined by the prior does not vary in the jackknife: add the width of the prior.
    held = problem.prior_share(best, mask)
    shared = np.hypot(_SYSTEMATIC, problem.shared_errors(best, mask, drift_rad_s))
    sigma = np.hypot(np.hypot(sigma, held * _PRIOR), shared)
    after = problem.residuals(best)
    return MotionCalibration(
        best, np.where(mask, sigma, np.inf), float(np.median(np.abs(after))),
        float(np.median(np.abs(before))), len(after) // 2,
    )  # fmt: skip


def _search_clock(problem: _Problem, mask: np.ndarray) -> float:
    """Return the time offset (s) of lowest cost on a grid, optimising yaw too (the most correlated)."""
    clocks = np.arange(-_SEARCH_S, _SEARCH_S + 1e-9, 0.02)
    rest = mask & (np.array(PARAMETERS) == "yaw_rad")
    start = np.zeros(len(PARAMETERS))
    costs = []
    for clock in clocks:
        start[0] = clock
        costs.append(problem.cost(problem.gauss_newton(start, rest, 1)))
    return float(clocks[int(np.argmin(costs))])


class _Problem:
    """Least-squares problem over all pairs; the corners of all pairs are concatenated."""

    def __init__(
        self, pairs: list[TrackedPair], pose_at: Callable[[int], np.ndarray | None],
        T_body_camera: np.ndarray, focal_px: float,
    ) -> None:  # fmt: skip
        self._pairs, self._pose_at = pairs, pose_at
        self._T_body_camera, self._focal_px = T_body_camera, focal_px
        self._of = np.repeat(np.arange(len(pairs)), [len(p.rays_a) for p in pairs])
        self._rays_a = np.concatenate([p.rays_a for p in pairs])
        self._rays_b = np.concatenate([p.rays_b for p in pairs])
        self._span_s = np.array([1e-9 * (p.stamp_b_ns - p.stamp_a_ns) for p in pairs])
        self._shift_ns: int | None = None

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Return the residuals [2M] (px) of all corners, see `reprojection`; 0 where a pose is missing."""
        self._interpolate_motions(round(x[0] * 1e9))
        mount = apply_correction(self._T_body_camera, x)
        T = inverse(mount) @ self._T_bodies @ mount
        r = reprojection(T[self._of], self._rays_a, self._rays_b, _TRACK_PX / self._focal_px) * self._focal_px
        return np.where(np.tile(self._known[self._of], 2), r, 0.0)

    def _interpolate_motions(self, shift_ns: int) -> None:
        """Compute the body motion `T_b_a` between the images of each pair, with stamps + `shift_ns`."""
        if shift_ns == self._shift_ns:
            return
        self._shift_ns = shift_ns
        self._T_bodies = np.tile(np.eye(4), (len(self._pairs), 1, 1))
        self._known = np.zeros(len(self._pairs), dtype=bool)
        for k, pair in enumerate(self._pairs):
            T_a, T_b = self._pose_at(pair.stamp_a_ns + shift_ns), self._pose_at(pair.stamp_b_ns + shift_ns)
            if T_a is not None and T_b is not None:
                self._T_bodies[k], self._known[k] = inverse(T_b) @ T_a, True

    def cost(self, x: np.ndarray) -> float:
        """Return the mean robust cost (Cauchy, scale 1 px) of the corners whose poses are known."""
        r = self.residuals(x)
        return float(np.sum(np.log1p(r**2))) / max(2 * int(self._known[self._of].sum()), 1)

    def prior_share(self, x: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Return float64 [6] in [0, 1]: the fraction of each value that the prior determines."""
        columns = np.flatnonzero(mask)
        share = np.ones(len(x))
        if len(columns):
            H, _, prior = self._normal(x, columns)
            share[columns] = np.clip(np.diag(np.linalg.solve(H, np.diag(prior))), 0.0, 1.0)
        return share

    def shared_errors(self, x: np.ndarray, mask: np.ndarray, drift_rad_s: float) -> np.ndarray:
        """Return the standard errors float64 [6] by drift of the poses and by errors of the fixed parameters.

        Both are consider parameters (Schmidt 1966). A drift of the yaw of the poses moves all corners to one
        side, which the estimation takes for a sideways motion, thus for a yaw of the mount; so does a fixed x
        in turns. Turns to both sides cancel, but the first pairs of a drive often turn to one side.

        Args:
            x: float64 [6], the estimate.
            mask: bool [6], True = free.
            drift_rad_s: standard deviation of the drift.
        """
        errors = np.zeros(len(x))
        columns, fixed = np.flatnonzero(mask), np.flatnonzero(~mask)
        if len(columns) == 0:
            return errors
        _, J, weight, prior = self._linear(x, np.arange(len(x)))
        causes = np.column_stack([J[:, fixed] * _SYSTEMATIC[fixed], self._drift_derivative(x) * drift_rad_s])
        J, prior = J[:, columns], prior[columns]
        H = J.T @ (J * weight[:, None]) + np.diag(prior)
        change = np.linalg.solve(H, J.T @ (causes * weight[:, None]))
        errors[columns] = np.sqrt(np.sum(change**2, axis=1))
        return errors

    def _drift_derivative(self, x: np.ndarray) -> np.ndarray:
        """Return the derivative [2M] (px s / rad) of the residuals by a drift of the yaw of the poses."""
        step_rad_s = 1e-4
        self._interpolate_motions(round(x[0] * 1e9))
        T_bodies = self._T_bodies
        residuals = []
        for sign in (1.0, -1.0):
            # T_b_a is turned half before and half after its translation, as by a constant drift.
            half_rad = -0.5 * sign * step_rad_s * self._span_s
            turn = np.array([so3_exp(np.array([0.0, 0.0, angle])) for angle in half_rad])
            self._T_bodies = T_bodies.copy()
            self._T_bodies[:, :3, :3] = turn @ T_bodies[:, :3, :3] @ turn
            self._T_bodies[:, :3, 3] = np.einsum("nij,nj->ni", turn, T_bodies[:, :3, 3])
            residuals.append(self.residuals(x))
        self._T_bodies = T_bodies
        return (residuals[0] - residuals[1]) / (2.0 * step_rad_s)

    def jackknife(self, x: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Return the standard error float64 [6] of each parameter, in the order and units of `PARAMETERS`.

        The image pairs are divided into consecutive blocks of equal length. One Gauss-Newton step is solved
        without each block, and the spread of these steps gives the error (jackknife). Parameters that are
        False in `mask` (bool [6]) are fixed and get 0.
        """
        sigma = np.zeros(len(x))
        columns = np.flatnonzero(mask)
        if len(columns) == 0:
            return sigma
        r, J, weight, prior = self._linear(x, columns)
        block = np.tile(self._of * _BLOCKS // len(self._pairs), 2)
        steps = []
        for number in range(_BLOCKS):
            w = np.where(block == number, 0.0, weight)
            H = J.T @ (J * w[:, None]) + np.diag(prior)
            steps.append(np.linalg.solve(H, J.T @ (w * r) + prior * x[columns]))
        spread = np.array(steps) - np.mean(steps, axis=0)
        sigma[columns] = np.sqrt((_BLOCKS - 1) / _BLOCKS * np.sum(spread**2, axis=0))
        return sigma

    def _linear(
        self, x: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return (residuals [2M], derivatives [2M, k], robust weights [2M], weights [k] of the prior)."""
        r = self.residuals(x)
        J = np.empty((len(r), len(columns)))
        for k, column in enumerate(columns):
            step = np.zeros(len(x))
            step[column] = _STEP[column]
            J[:, k] = (self.residuals(x + step) - self.residuals(x - step)) / (2.0 * _STEP[column])
        scale = max(0.5, 1.4826 * float(np.median(np.abs(r))))
        weight = 1.0 / (1.0 + (r / scale) ** 2) ** 2
        # The corners of a pair share the error of its two poses: together they have the weight of one.
        return r, J, weight, scale**2 * len(r) / 2 / len(self._pairs) / _PRIOR[columns] ** 2

    def _normal(self, x: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (H [k, k], gradient [k], weights [k] of the prior) of the robust normal equations at x."""
        r, J, weight, prior = self._linear(x, columns)
        return J.T @ (J * weight[:, None]) + np.diag(prior), J.T @ (weight * r) + prior * x[columns], prior

    def gauss_newton(self, x: np.ndarray, mask: np.ndarray, iterations: int) -> np.ndarray:
        """Return x after up to `iterations` Gauss-Newton steps over the parameters of `mask`."""
        x = x.copy()
        columns = np.flatnonzero(mask)
        if len(columns) == 0:
            return x
        for _ in range(iterations):
            H, gradient, _ = self._normal(x, columns)
            delta = np.linalg.solve(H, gradient)
            x[columns] -= delta
            if np.all(np.abs(delta) < 0.1 * _STEP[columns]):
                break
        return x


def reprojection(
    T_b_a: np.ndarray,  # float64 [N, 4, 4], camera a to camera b, of each corner
    rays_a: np.ndarray,  # float64 [N, 3]
    rays_b: np.ndarray,  # float64 [N, 3]
    sigma: float,  # of a track, normalised pixels
) -> np.ndarray:
    """Return distances [2N] (at z = 1) of tracked rays from their prediction by pose and mean depth.

    The inverse depth of a corner has a Gaussian prior and is marginalised: the distance across the epipolar
    line has full weight; the distance along the line has less weight, the more the unknown depth moves the
    corner. Thus rotation remains observable without translation, where the epipolar constraint is degenerate.
    """
    t = T_b_a[:, :3, 3]
    p = np.einsum("nij,nj->ni", T_b_a[:, :3, :3], rays_a) + _INVERSE_DEPTH * t
    z = np.maximum(p[:, 2:], 0.1)
    predicted = p[:, :2] / z
    r = rays_b[:, :2] - predicted
    along = (t[:, :2] - predicted * t[:, 2:]) / z  # d predicted / d inverse depth
    length = np.sqrt(np.sum(along**2, axis=1)) + 1e-12
    x, y = along.T / length
    fade = np.sqrt(1.0 + (_INVERSE_DEPTH_SIGMA * length / sigma) ** 2)
    return np.concatenate([r[:, 1] * x - r[:, 0] * y, (r[:, 0] * x + r[:, 1] * y) / fade])
