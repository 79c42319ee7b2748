"""Hypotheses about what is wrong with a robot's calibration, and how well each explains the tracked corners.

Each hypothesis changes the rays of the corners (image, K, distortion), the motions of the body (lidar, clock)
or the mount of the camera, with a few free parameters. All are fitted to the same corners; the cost is the
mean robust distance, in pixels of the images as they are, of the corners from their prediction by pose and
depth (`motion.reprojection`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from beamsplat.common.geometry.transforms import inverse, so3_exp
from beamsplat.services.fusion.calibration.motion import TrackedPair, reprojection

PoseAt = Callable[[int], np.ndarray | None]
_TRACK_PX = 0.3  # standard deviation of a corner track
_SCALE_PX = 1.0  # of the robust cost (Cauchy)
_ITERATIONS = 8
_MOST_CORNERS = 800  # for the fits; evenly spread over the pairs
_STEP = 1e-4
_UNDER_FLOOR_M = 0.5
_LEAST_PARALLAX_PX = 6.0  # of a corner whose depth is used


@dataclass(frozen=True)
class Hypothesis:
    """A possible fault. `free`: names of its parameters; `starts`: their start values, one row each.

    Parameters: clock (s); roll, pitch, yaw (rad, added to the mount about the body axes); shift_x, shift_y
    (of the principal point, focal lengths); log_focal (true focal length = stated * exp(log_focal)); size
    (likewise, with the principal point scaled as in an image of another size); k1 (first coefficient of the
    missing distortion).
    """

    cause: str
    free: tuple[str, ...] = ()
    starts: tuple[tuple[float, ...], ...] = ()
    image: np.ndarray = field(default_factory=lambda: np.eye(2))  # applied to (x, y) of the rays
    lidar: np.ndarray = field(default_factory=lambda: np.eye(4))  # applied in the frame of the lidar
    optical: bool = False  # the stated mount is that of the housing


@dataclass(frozen=True)
class Fit:
    """A fitted hypothesis: the values of its parameters by name, its cost and its median residual."""

    hypothesis: Hypothesis
    values: dict[str, float]
    cost: float  # mean of log(1 + (r / 1 px)^2) over corners and axes
    residual_px: float


class CornerProblem:
    """The corners of all image pairs with the motion of the body between the images."""

    def __init__(
        self, pairs: list[TrackedPair], pose_at: PoseAt, T_body_camera: np.ndarray, T_body_lidar: np.ndarray,
        focal_px: float, centre: tuple[float, float] = (0.0, 0.0),
    ) -> None:  # fmt: skip
        """`centre`: direction of the upper left corner of the image, (u - cx) / fx, (v - cy) / fy there."""
        total = sum(len(pair.rays_a) for pair in pairs)
        every = max(1, -(-total // _MOST_CORNERS))
        self._pairs, self._pose_at = pairs, pose_at
        self._of = np.repeat(np.arange(len(pairs)), [len(p.rays_a[::every]) for p in pairs])
        self._a = np.concatenate([p.rays_a[::every, :2] for p in pairs])
        self._b = np.concatenate([p.rays_b[::every, :2] for p in pairs])
        self._T_body_camera, self._T_body_lidar = T_body_camera, T_body_lidar
        self._focal_px = focal_px
        self._corner = np.asarray(centre)
        self._motions: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def explained(self, fits: list[Fit], within_px: float) -> np.ndarray:
        """Return bool [M]: whether at least one of the fits predicts a corner within a distance.

        Corners on people that walk by, and wrong tracks, are explained by none.
        """
        nearest = np.full(len(self._of), np.inf)
        for fit in fits:
            _, known = self._motion(round(fit.values.get("clock", 0.0) * 1e9))
            r = self.residuals(fit.hypothesis, np.array(list(fit.values.values())))
            distance = np.full(len(self._of), np.inf)
            distance[known[self._of]] = np.hypot(*r.reshape(2, -1))
            nearest = np.minimum(nearest, distance)
        return nearest < within_px

    def restrict(self, kept: np.ndarray) -> None:
        """Remove the corners that are False in `kept`, bool [M]."""
        self._of, self._a, self._b = self._of[kept], self._a[kept], self._b[kept]

    def fit(self, hypothesis: Hypothesis) -> Fit:
        """Fit the parameters of a hypothesis from the best of its starts."""
        starts = np.array(hypothesis.starts or ((0.0,) * len(hypothesis.free),), dtype=np.float64)
        costs = [self._cost(self.residuals(hypothesis, start)) for start in starts]
        x = self._gauss_newton(hypothesis, starts[int(np.argmin(costs))])
        r = self.residuals(hypothesis, x)
        values = dict(zip(hypothesis.free, x.tolist()))
        return Fit(hypothesis, values, self._cost(r), float(np.median(np.abs(r))) if len(r) else np.nan)

    def residuals(self, hypothesis: Hypothesis, x: np.ndarray) -> np.ndarray:
        """Return the residuals [2M] (px) of all corners whose poses are known."""
        values = dict(zip(hypothesis.free, x))
        T_bodies, known = self._motion(round(values.get("clock", 0.0) * 1e9))
        lidar = self._T_body_lidar @ hypothesis.lidar @ inverse(self._T_body_lidar)
        mount = self._mount(hypothesis, values)
        X = inverse(mount) @ lidar
        T = X @ T_bodies @ np.linalg.inv(lidar) @ mount
        factor = self._focal_factor(values)
        rays_a, rays_b = (self._rays(hypothesis, values, rays) for rays in (self._a, self._b))
        focal_px = self._focal_px * factor
        r = reprojection(T[self._of], rays_a, rays_b, _TRACK_PX / focal_px) * focal_px
        return r[np.tile(known[self._of], 2)]

    def _rays(self, hypothesis: Hypothesis, values: dict[str, float], xy: np.ndarray) -> np.ndarray:
        """Return rays [M, 3] with z = 1 as the camera would have if the hypothesis is right."""
        xy = xy @ hypothesis.image.T
        if "shift_x" in values:
            xy = xy - [values["shift_x"], values["shift_y"]]
        if "size" in values:  # pixels are counted from the corner of the image
            xy = xy - self._corner * (1.0 - np.exp(values["size"]))
        xy = xy / self._focal_factor(values)
        if "k1" in values:
            # x = distorted; x_true (1 + k1 r_true^2) = x, solved by two fixed-point steps.
            true = xy
            for _ in range(4):
                r2 = np.minimum(np.sum(true**2, axis=1, keepdims=True), 4.0)
                true = xy / np.maximum(1.0 + r2 * (values["k1"] + values.get("k2", 0.0) * r2), 0.3)
            xy = true
        return np.column_stack([xy, np.ones(len(xy))])

    def below_floor_share(self, fit: Fit) -> float:
        """Return the fraction of the corners with a known depth that would be under the floor.

        Motions in a plane do not show which way up an image is; but no corner is under the floor. The limit
        of 0.5 m allows for a wrong height of the camera; upside down, what is high in a room is lower than
        that. NaN without corners of a known depth.
        """
        values = fit.values
        T_bodies, known = self._motion(round(values.get("clock", 0.0) * 1e9))
        lidar = self._T_body_lidar @ fit.hypothesis.lidar @ inverse(self._T_body_lidar)
        mount = self._mount(fit.hypothesis, values)
        T = (inverse(mount) @ lidar @ T_bodies @ np.linalg.inv(lidar) @ mount)[self._of]
        a, b = (self._rays(fit.hypothesis, values, rays) for rays in (self._a, self._b))
        # depth_b b = depth_a R a + t: the depth along a that makes both parallel (least squares).
        turned = np.einsum("nij,nj->ni", T[:, :3, :3], a)
        across, along = np.cross(b, turned), np.cross(b, T[:, :3, 3])
        parallax = np.sum(across**2, axis=1)
        depth = -np.sum(across * along, axis=1) / np.maximum(parallax, 1e-12)
        shift_px = np.linalg.norm(T[:, :3, 3], axis=1) / np.maximum(depth, 0.1) * self._focal_px
        sure = known[self._of] & (depth > 0.3) & (depth < 8.0) & (shift_px > _LEAST_PARALLAX_PX)
        if sure.sum() < 30:
            return np.nan
        points = a[sure] * depth[sure, None] @ mount[:3, :3].T + mount[:3, 3]
        return float(np.mean(points[:, 2] < -_UNDER_FLOOR_M))

    @staticmethod
    def _focal_factor(values: dict[str, float]) -> float:
        return float(np.exp(values.get("log_focal", 0.0) + values.get("size", 0.0)))

    def _mount(self, hypothesis: Hypothesis, values: dict[str, float]) -> np.ndarray:
        mount = self._T_body_camera.copy()
        if hypothesis.optical:
            mount[:3, :3] = mount[:3, :3] @ _HOUSING_OPTICAL
        for name, axis in (("roll", 0), ("pitch", 1), ("yaw", 2)):
            if name in values:
                mount[:3, :3] = so3_exp(values[name] * np.eye(3)[axis]) @ mount[:3, :3]
        return mount

    def _motion(self, shift_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (motions `T_b_a` of the body [P, 4, 4], known [P]) with image stamps + `shift_ns`."""
        if shift_ns not in self._motions:
            T_bodies = np.tile(np.eye(4), (len(self._pairs), 1, 1))
            known = np.zeros(len(self._pairs), dtype=bool)
            for k, pair in enumerate(self._pairs):
                T_a, T_b = (
                    self._pose_at(pair.stamp_a_ns + shift_ns),
                    self._pose_at(pair.stamp_b_ns + shift_ns),
                )
                if T_a is not None and T_b is not None:
                    T_bodies[k], known[k] = inverse(T_b) @ T_a, True
            self._motions[shift_ns] = T_bodies, known
        return self._motions[shift_ns]

    @staticmethod
    def _cost(r: np.ndarray) -> float:
        return float(np.mean(np.log1p((r / _SCALE_PX) ** 2))) if len(r) else np.inf

    def _gauss_newton(self, hypothesis: Hypothesis, x: np.ndarray) -> np.ndarray:
        """Return x after damped Gauss-Newton steps on the robust cost; a step that does not help ends it."""
        if not len(x):
            return x
        step = np.array([2e-3 if name == "clock" else _STEP for name in hypothesis.free])
        r = self.residuals(hypothesis, x)
        cost = self._cost(r)
        for _ in range(_ITERATIONS):
            J = np.empty((len(r), len(x)))
            for k in range(len(x)):
                moved = x.copy()
                moved[k] += step[k]
                other = self.residuals(hypothesis, moved)
                if len(other) != len(r):  # a clock beyond the poses
                    return x
                J[:, k] = (other - r) / step[k]
            scale = max(_SCALE_PX, 1.4826 * float(np.median(np.abs(r))))
            weight = 1.0 / (1.0 + (r / scale) ** 2)
            H = J.T @ (J * weight[:, None])
            try:
                delta = np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(len(x)), J.T @ (weight * r))
            except np.linalg.LinAlgError:
                return x
            improved = False
            for damping in (1.0, 0.4, 0.1):
                moved = x - damping * delta
                moved_r = self.residuals(hypothesis, moved)
                moved_cost = self._cost(moved_r)
                if len(moved_r) == len(r) and moved_cost < cost - 1e-6:
                    x, r, cost, improved = moved, moved_r, moved_cost, True
                    break
            if not improved:
                break
        return x


# x right, y down, z forward in x forward, y left, z up.
_HOUSING_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
