"""Wheel odometry: integrates the true motion with errors of wheel radius and track width."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.transforms import wrap_angle
from beamsplat.tools.simulator.settings import WheelSettings

TRACK_M = 0.4  # distance between the wheels
# A slip lasts for this travel, and the wheel turns too far by this share of it: 0.7 to 9 degrees.
SLIP_M, SLIP_SHARE = (0.05, 0.2), (0.1, 0.3)


@dataclass(frozen=True)
class WheelReadings:
    """M odometry readings; the pose of the first reading of a recording is the origin of the odom frame."""

    pose_odom_body: np.ndarray  # float64 [M, 3], (x, y, yaw)
    speed_m_s: np.ndarray  # float64 [M], forward speed
    turn_rad_s: np.ndarray  # float64 [M], yaw rate


class WheelOdometrySimulator:
    """Wheel odometry of one robot; systematic errors are drawn once, and the pose is stored between calls."""

    def __init__(self, settings: WheelSettings, rng: np.random.Generator, slips_per_km: float = 0.0) -> None:
        self._noise, self._rng = settings.noise, rng
        self._slips_per_m = slips_per_km * 1e-3
        self._slip_left_m, self._slip = 0.0, 0.0
        self.scale = 1.0 + _signed(rng, settings.scale_error)
        self.turn = 1.0 + _signed(rng, settings.turn_error)
        self._pose_odom_body = np.zeros(3)
        self._last_pose_world_body: np.ndarray | None = None

    def measure(self, pose_world_body: np.ndarray, period_s: float) -> WheelReadings:
        """Return the odometry readings at M true poses of the robot.

        Args:
            pose_world_body: float64 [M, 3], (x, y, yaw); follows the last pose of the previous call.
            period_s: time between two poses in seconds.
        """
        first = (
            pose_world_body[:1] if self._last_pose_world_body is None else self._last_pose_world_body[None]
        )
        chain = np.concatenate([first, pose_world_body])
        self._last_pose_world_body = pose_world_body[-1].copy()
        move = np.diff(chain[:, :2], axis=0)
        turn = np.asarray(wrap_angle(np.diff(chain[:, 2])))
        middle = chain[:-1, 2] + turn / 2
        forward = move[:, 0] * np.cos(middle) + move[:, 1] * np.sin(middle)
        # Slip grows with the motion: while the robot stands still, its odometry does not drift.
        noise = self._rng.standard_normal((2, len(pose_world_body)))
        forward = forward * self.scale + self._noise * np.sqrt(np.abs(forward) * 0.01) * noise[0]
        turn = (
            turn * self.turn
            + self._noise * np.sqrt(np.abs(turn) * 0.02 + np.abs(forward) * 0.0005) * noise[1]
        )
        if self._slips_per_m > 0.0:
            excess = self._slip_excess(np.abs(forward))
            forward, turn = forward + np.abs(excess) / 2.0, turn + excess / TRACK_M
        yaw = self._pose_odom_body[2] + np.cumsum(turn)
        along = yaw - turn / 2
        x = self._pose_odom_body[0] + np.cumsum(forward * np.cos(along))
        y = self._pose_odom_body[1] + np.cumsum(forward * np.sin(along))
        out = np.stack([x, y, yaw], axis=1)
        self._pose_odom_body = out[-1].copy()
        out[:, 2] = wrap_angle(out[:, 2])
        return WheelReadings(out, forward / period_s, turn / period_s)

    def _slip_excess(self, metres: np.ndarray) -> np.ndarray:
        """Return what one wheel turns too far during each step, in metres: positive = the right wheel.

        `metres` float64 [M] are the lengths of the steps. The number of random draws is that of the steps.
        """
        starts = self._rng.random(len(metres)) < metres * self._slips_per_m
        length, share, side = self._rng.random((3, len(metres)))
        excess = np.zeros(len(metres))
        for k, step_m in enumerate(metres):
            if starts[k]:
                self._slip_left_m = SLIP_M[0] + length[k] * (SLIP_M[1] - SLIP_M[0])
                self._slip = SLIP_SHARE[0] + share[k] * (SLIP_SHARE[1] - SLIP_SHARE[0])
                self._slip *= 1.0 if side[k] < 0.5 else -1.0
            if self._slip_left_m > 0.0:
                excess[k] = self._slip * step_m
                self._slip_left_m -= step_m
        return excess


def _signed(rng: np.random.Generator, span: tuple[float, float]) -> float:
    return float(rng.uniform(*span) * rng.choice([-1.0, 1.0]))
