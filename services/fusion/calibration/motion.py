"""Camera clock and camera mount from motion: corners tracked between pictures against poses from the lidar.

Two pictures a fraction of a second apart obey the epipolar constraint only if the poses are taken at the
right times and the camera looks the right way. Turning tells the clock (where the rate of turn changes)
and the lever arm, driving tells yaw and pitch, both tell roll. A robot on a floor never moves along its
own vertical: the camera's height cannot be told from its motion, and is said not to be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.geometry import inverse, skew, so3_exp

PARAMETERS = ("clock_s", "roll_rad", "pitch_rad", "yaw_rad", "x_m", "y_m")
_PRIOR = np.array([0.3, 0.1, 0.1, 0.1, 0.03, 0.03])  # standard deviations: keeps what nothing tells in place
_STEP = np.array([1e-3, 1e-5, 1e-5, 1e-5, 1e-4, 1e-4])
_SEARCH_S = 0.32
_LEAST_BASELINE_M = 0.005
_BLOCKS = 8  # of the drive: the jackknife leaves out one at a time
# A standard error above this is no measurement.
OBSERVABLE = np.array([0.025, 0.01, 0.01, 0.01, 0.02, 0.02])


@dataclass(frozen=True)
class TrackedPair:
    """Corners seen in two pictures; stamps on the camera's clock."""

    stamp_a_ns: int
    stamp_b_ns: int
    rays_a: np.ndarray  # float64 [N, 3], z = 1
    rays_b: np.ndarray  # float64 [N, 3]


@dataclass(frozen=True)
class MotionCalibration:
    """Corrections by PARAMETERS, with standard errors; `clock_s` is added to camera stamps."""

    values: np.ndarray  # float64 [6]
    sigma: np.ndarray  # float64 [6], inf = not looked for
    residual_px: float  # median |epipolar distance| after
    residual_before_px: float
    corners: int

    @property
    def observable(self) -> np.ndarray:
        """bool [6]: whether the drive tells this value at all."""
        return self.sigma < OBSERVABLE

    def mount(self, T_body_camera: np.ndarray) -> np.ndarray:
        """`T_body_camera` [4, 4] with the observable corrections in."""
        return corrected(T_body_camera, np.where(self.observable, self.values, 0.0))


def corrected(T_body_camera: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The mount turned by (roll, pitch, yaw) about the body's axes, and moved by (x, y)."""
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
) -> MotionCalibration:
    """Most probable corrections: a search over the clock, then Gauss-Newton on all free parameters.

    Standard errors come from a jackknife over blocks of the drive: corners of one picture err together.

    Raises:
        ValueError: too few pairs with corners and poses.
    """
    pairs = [p for p in pairs if len(p.rays_a) >= 8]
    if len(pairs) < 2 * _BLOCKS:
        raise ValueError(
            f"only {len(pairs)} pairs of pictures with tracked corners; {2 * _BLOCKS} are needed"
        )
    mask = np.array([name in free for name in PARAMETERS])
    start = np.zeros(len(PARAMETERS))
    problem = _Problem(pairs, pose_at, T_body_camera, focal_px)
    before = problem.residuals(start)
    if mask[0]:
        clocks = np.arange(-_SEARCH_S, _SEARCH_S + 1e-9, 0.02)
        # Yaw is the mount error that most looks like a wrong clock: it follows along.
        rest = mask & (np.array(PARAMETERS) == "yaw_rad")
        costs = []
        for clock in clocks:
            x = np.concatenate([[clock], start[1:]])
            costs.append(problem.cost(problem.descend(x, rest, 1)))
        start[0] = clocks[int(np.argmin(costs))]
    best = problem.descend(start, mask, 12)
    groups = np.array_split(np.arange(len(pairs)), _BLOCKS)
    estimates = []
    for group in groups:
        kept = [pairs[i] for i in range(len(pairs)) if i not in set(group.tolist())]
        estimates.append(_Problem(kept, pose_at, T_body_camera, focal_px).descend(best.copy(), mask, 4))
    spread = np.array(estimates) - np.mean(estimates, axis=0)
    sigma = np.sqrt((_BLOCKS - 1) / _BLOCKS * np.sum(spread**2, axis=0))
    # What the prior holds does not scatter, and is not known for that: its own width counts instead.
    held = problem.held_by_prior(best, mask)
    sigma = np.hypot(sigma, held * _PRIOR)
    after = problem.residuals(best)
    return MotionCalibration(
        best, np.where(mask, sigma, np.inf), float(np.median(np.abs(after))),
        float(np.median(np.abs(before))), len(after),
    )  # fmt: skip


class _Problem:
    def __init__(
        self, pairs: list[TrackedPair], pose_at: Callable[[int], np.ndarray | None],
        T_body_camera: np.ndarray, focal_px: float,
    ) -> None:  # fmt: skip
        self._pairs, self._pose_at = pairs, pose_at
        self._T_body_camera, self._focal_px = T_body_camera, focal_px

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Signed epipolar distances of all corners, pixels; zero where a pose is missing."""
        mount = corrected(self._T_body_camera, x)
        shift_ns = round(x[0] * 1e9)
        out = []
        for pair in self._pairs:
            T_a, T_b = self._pose_at(pair.stamp_a_ns + shift_ns), self._pose_at(pair.stamp_b_ns + shift_ns)
            if T_a is None or T_b is None:
                out.append(np.zeros(len(pair.rays_a)))
                continue
            T = inverse(T_b @ mount) @ (T_a @ mount)
            out.append(symmetric_epipolar(T, pair.rays_a, pair.rays_b) * self._focal_px)
        return np.concatenate(out)

    def cost(self, x: np.ndarray) -> float:
        """Robust cost (Cauchy, scale 1 px)."""
        return float(np.sum(np.log1p(self.residuals(x) ** 2)))

    def held_by_prior(self, x: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Share [6] in [0, 1] of each value that comes from the prior and not from the pictures."""
        columns = np.flatnonzero(mask)
        share = np.ones(len(x))
        if len(columns):
            H, _, prior = self._normal(x, columns)
            share[columns] = np.clip(np.diag(np.linalg.solve(H, np.diag(prior))), 0.0, 1.0)
        return share

    def _normal(self, x: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(H [k, k], gradient [k], weights [k] of the prior) of the robust least squares at x."""
        r = self.residuals(x)
        J = np.empty((len(r), len(columns)))
        for k, column in enumerate(columns):
            step = np.zeros(len(x))
            step[column] = _STEP[column]
            J[:, k] = (self.residuals(x + step) - self.residuals(x - step)) / (2.0 * _STEP[column])
        scale = max(0.5, 1.4826 * float(np.median(np.abs(r))))
        weight = 1.0 / (1.0 + (r / scale) ** 2) ** 2
        # The corners of a pair share the error of its two poses: together they weigh as one.
        prior = scale**2 * len(r) / len(self._pairs) / _PRIOR[columns] ** 2
        return J.T @ (J * weight[:, None]) + np.diag(prior), J.T @ (weight * r) + prior * x[columns], prior

    def descend(self, x: np.ndarray, mask: np.ndarray, iterations: int) -> np.ndarray:
        """Gauss-Newton over the parameters of `mask`."""
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


def symmetric_epipolar(T_b_a: np.ndarray, rays_a: np.ndarray, rays_b: np.ndarray) -> np.ndarray:
    """Sampson distances [N] in normalised pixels.

    With hardly any baseline the constraint says nothing; the distance fades out below 5 mm.
    """
    t = T_b_a[:3, 3]
    E = skew(t) @ T_b_a[:3, :3]
    line_b, line_a = rays_a @ E.T, rays_b @ E
    scale = np.sqrt(np.sum(line_b[:, :2] ** 2, axis=1) + np.sum(line_a[:, :2] ** 2, axis=1))
    return np.sum(line_b * rays_b, axis=1) / np.maximum(scale, _LEAST_BASELINE_M)
