"""Check of scans against wheel odometry: mirrored scans, mount, unit of the ranges, clocks.

The motion of the lidar (by ICP of its sweeps) and that of the body (by wheel odometry) in one second obey
R_body t_mount + t_body = R_mount s t_lidar + t_mount, the planar hand-eye equation: A. Censi et al.,
"Simultaneous calibration of odometry and sensor parameters for mobile robots", T-RO 2013. It is linear in the
mount's position and in s (cos yaw, sin yaw), where s is the scale of the odometry relative to the ranges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.common.scans.sweeps import between

_WINDOW_S = 1.0  # of one compared motion
_MIN_MOTIONS = 12
_MIN_TURN_RAD = 0.3  # sum of the turns, for the sign of the scans' direction
_MIN_PATH_M = 1.0  # sum of the distances, for the mount
_DELAYS_S = np.arange(-40, 41) * 0.025
_SLIP_RAD = 0.02  # turns that differ by less are noise


@dataclass(frozen=True)
class MountEstimate:
    """The lidar's mount as the motion shows it; angles in rad, with standard deviations."""

    yaw_rad: float
    yaw_sigma_rad: float
    xy_m: np.ndarray  # float64 [2]
    xy_sigma_m: float
    scale: float  # metres of odometry per metre of the ranges
    motions: int


class MotionComparison:
    """Collects motions of the lidar and of the body over the same intervals."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._poses: list[np.ndarray] = []  # pose_odom_body
        self._lidar: list[tuple[int, int, np.ndarray]] = []  # start, end (ns), motion [3] of the lidar
        self._window: tuple[int, int, np.ndarray] | None = None  # chain, stamp, pose of the window's start
        self._rates: list[tuple[int, float]] = []  # stamp, turn rate of the lidar (rad/s)

    def add_odometry(self, stamp_ns: int, pose_odom_body: np.ndarray) -> None:
        """Add a pose float64 [3] (x m, y m, yaw rad); one that is not newer than the last is ignored."""
        if np.all(np.isfinite(pose_odom_body)) and (not self._stamps or stamp_ns > self._stamps[-1]):
            yaw = float(pose_odom_body[2])
            if self._poses:
                last = float(self._poses[-1][2])
                yaw = last + (yaw - last + math.pi) % (2.0 * math.pi) - math.pi
            self._stamps.append(stamp_ns)
            self._poses.append(np.array([pose_odom_body[0], pose_odom_body[1], yaw]))

    def add_lidar(self, chain: int, stamp_ns: int, pose: np.ndarray, turn_rate_rad_s: float) -> None:
        """Add a pose float64 [3] of the lidar in the frame of its chain, at the middle of a sweep."""
        self._rates.append((stamp_ns, turn_rate_rad_s))
        if self._window is None or self._window[0] != chain or stamp_ns < self._window[1]:
            self._window = (chain, stamp_ns, pose)
            return
        if stamp_ns - self._window[1] >= _WINDOW_S * 1e9:
            self._lidar.append((self._window[1], stamp_ns, between(self._window[2], pose)))
            self._window = (chain, stamp_ns, pose)

    @property
    def has_odometry(self) -> bool:
        return len(self._stamps) >= 2

    def _bodies(self, delay_ns: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return (motion of the body, motion of the lidar) of all intervals with odometry around them."""
        found: list[tuple[np.ndarray, np.ndarray]] = []
        if not self.has_odometry:
            return found
        stamps, poses = np.array(self._stamps, np.int64), np.array(self._poses)
        for start, end, lidar in self._lidar:
            at = np.array([start, end], np.int64) + delay_ns
            if at[0] < stamps[0] or at[1] > stamps[-1]:
                continue
            x = (at - stamps[0]) * 1e-9
            around = [
                np.array([np.interp(t, (stamps - stamps[0]) * 1e-9, poses[:, k]) for k in range(3)])
                for t in x
            ]
            found.append((between(around[0], around[1]), lidar))
        return found

    def delay_s(self) -> tuple[float, float] | None:
        """Return by how much the odometry's stamps are later than those of the scans, and the precision (s).

        Found from the turn rates, at the delay where they agree best; None if the robot does not turn enough.
        """
        if len(self._rates) < 20 or not self.has_odometry:
            return None
        stamps, poses = np.array(self._stamps, np.int64), np.array(self._poses)
        zero = stamps[0]
        t_odometry = (stamps - zero) * 1e-9
        t = (np.array([stamp for stamp, _ in self._rates], np.int64) - zero) * 1e-9
        rate = np.array([value for _, value in self._rates])
        inside = (t > t_odometry[0] + 1.2) & (t < t_odometry[-1] - 1.2)
        if inside.sum() < 20 or float(np.std(rate[inside])) < 0.05:
            return None
        half = 0.1
        costs = []
        for delay in _DELAYS_S:
            at = t[inside] + delay
            turned = np.interp(at + half, t_odometry, poses[:, 2]) - np.interp(
                at - half, t_odometry, poses[:, 2]
            )
            costs.append(float(np.mean(np.minimum(np.abs(turned / (2.0 * half) - rate[inside]), 0.5))))
        cost = np.array(costs)
        best = int(cost.argmin())
        if cost[best] > 0.5 * float(np.median(cost)) or best in (0, len(cost) - 1):
            return None
        near = np.flatnonzero(cost < cost[best] + 0.1 * (float(np.median(cost)) - cost[best]))
        return float(_DELAYS_S[best]), float(0.5 * (_DELAYS_S[near[-1]] - _DELAYS_S[near[0]]) + 0.0125)

    def handedness(self) -> float | None:
        """Return the correlation of the turns of lidar and body, -1 to 1; None if there was too little turn.

        A value near -1 says that the scans are mirrored (or that the yaw of the odometry has the wrong sign).
        """
        pairs = self._bodies()
        body = np.array([b[2] for b, _ in pairs])
        lidar = np.array([a[2] for _, a in pairs])
        if len(pairs) < 5 or np.abs(body).sum() < _MIN_TURN_RAD or np.abs(lidar).sum() < 0.5 * _MIN_TURN_RAD:
            return None
        return float((body @ lidar) / max(np.linalg.norm(body) * np.linalg.norm(lidar), 1e-9))

    def odometry_is_consistent(self) -> bool:
        """Return whether the path of the odometry is along its own heading, as that of wheels is."""
        steps = np.array([b for b, _ in self._bodies()]).reshape(-1, 3)
        # The chord of an arc points along the mean heading.
        middle = -0.5 * steps[:, 2]
        along = np.cos(middle) * steps[:, 0] - np.sin(middle) * steps[:, 1]
        across = np.sin(middle) * steps[:, 0] + np.cos(middle) * steps[:, 1]
        moving = np.hypot(steps[:, 0], steps[:, 1]) > 0.05
        heading = np.cumsum(steps[:, 2])[moving]
        # With a wrong sign of the yaw, the path leaves the heading as soon as the robot has turned.
        if moving.sum() < 3 or float(np.ptp(heading)) < _MIN_TURN_RAD:
            return False
        return bool(np.median(np.abs(across[moving])) < 0.1 * np.median(np.abs(along[moving])))

    def mount(self, *, mirrored: bool = False) -> MountEstimate | None:
        """Return the planar mount of the lidar; None if the robot has not moved enough.

        `mirrored`: the motion of the lidar is mirrored first (y and yaw change sign).
        """
        pairs = self._bodies()
        flip = np.array([1.0, -1.0, -1.0]) if mirrored else np.ones(3)
        rows, values, usable = [], [], 0
        path = 0.0
        for body, lidar in pairs:
            lidar = lidar * flip
            if abs(body[2] - lidar[2]) > _SLIP_RAD + 0.1 * abs(lidar[2]):
                continue
            c, s = math.cos(lidar[2]) - 1.0, math.sin(lidar[2])  # the turn of the lidar is the more accurate
            x, y = lidar[:2]
            rows += [[c, -s, -x, y], [s, c, -y, -x]]
            values += [-body[0], -body[1]]
            usable += 1
            path += math.hypot(body[0], body[1])
        if usable < _MIN_MOTIONS or path < _MIN_PATH_M or usable < 0.5 * len(pairs):
            return None
        A, b = np.array(rows), np.array(values)
        weight = np.ones(len(b))
        for _ in range(5):
            # A weak prior of 0 on the position, which straight motion does not show.
            normal = (A * weight[:, None]).T @ A + np.diag([1e-4, 1e-4, 0.0, 0.0])
            found = np.linalg.solve(normal, (A * weight[:, None]).T @ b)
            error = A @ found - b
            sigma = max(1.4826 * float(np.median(np.abs(error))), 2e-3)
            weight = 1.0 / (1.0 + (error / (3.0 * sigma)) ** 2) ** 2
        covariance = np.linalg.inv(normal) * sigma**2 * 4.0  # motions of one drive have common errors
        scale = math.hypot(found[2], found[3])
        return MountEstimate(
            yaw_rad=math.atan2(found[3], found[2]),
            yaw_sigma_rad=math.sqrt(max(covariance[2, 2], covariance[3, 3])) / max(scale, 1e-6),
            xy_m=found[:2],
            xy_sigma_m=math.sqrt(max(covariance[0, 0], covariance[1, 1])),
            scale=scale,
            motions=usable,
        )
