"""People who walk up and down the corridors of an office floor; a lidar near the floor sees their legs."""

from __future__ import annotations

import numpy as np

from beamsplat.tools.simulator.office.floor import FloorPlan

LEG_RADIUS_M = 0.065
SPEED_M_S = (0.6, 1.5)
STRIDE_M = 0.7  # distance between two steps of the same walk
LEG_DISTANCE_M = 0.11  # of each leg from the middle of the body
PAUSE_S = (2.0, 20.0)  # at each end of a walk
PERSONAL_M = 0.7  # nobody comes nearer to the robot


class People:
    """People with periodic walks, two legs each; a person steps aside for the robot."""

    def __init__(self, floor: FloorPlan, count: int, rng: np.random.Generator) -> None:
        """Give each person a piece of a corridor, a speed, and pauses at both ends."""
        crossings = np.array([[x, y] for x in floor.corridor_x_m for y in floor.corridor_y_m])
        ends, speed, pause, phase = [], [], [], []
        for _ in range(count):
            a = crossings[int(rng.integers(len(crossings)))]
            same = crossings[(np.abs(crossings - a) < 1e-9).any(axis=1)]
            others = same[np.hypot(*(same - a).T) > 1.0]
            b = others[int(rng.integers(len(others)))]
            side = np.array([a[1] - b[1], b[0] - a[0]]) / np.hypot(*(b - a)) * rng.uniform(-0.6, 0.6)
            ends.append(np.concatenate([a + side, b + side]))
            speed.append(rng.uniform(*SPEED_M_S))
            pause.append(rng.uniform(*PAUSE_S))
            phase.append(rng.random())
        self._ends = np.array(ends).reshape(-1, 4)
        self._speed, self._pause, self._phase = np.array(speed), np.array(pause), np.array(phase)

    def circles(self, time_s: np.ndarray, robot_m: np.ndarray, range_m: float) -> np.ndarray:
        """Return the legs near the robot, float64 [T, C, 3]: x, y, radius in metres.

        Args:
            time_s: float64 [T], seconds since the start.
            robot_m: float64 [T, 2], positions of the robot.
            range_m: people farther than this at the first time are left out.
        """
        if len(self._ends) == 0:
            return np.zeros((len(time_s), 0, 3))
        a, b = self._ends[:, :2], self._ends[:, 2:]
        length = np.hypot(*(b - a).T)
        walk_s = length / self._speed
        period = 2.0 * (walk_s + self._pause)
        t = np.mod(time_s[:, None] + self._phase * period, period)  # [T, P]
        back = t >= walk_s + self._pause
        walked = np.minimum(np.where(back, t - walk_s - self._pause, t) * self._speed, length)
        along = np.where(back, length - walked, walked)
        direction = (b - a) / length[:, None]
        centre = a + along[..., None] * direction
        near = np.flatnonzero(np.hypot(*(centre[0] - robot_m[0]).T) < range_m)
        centre, along, direction = centre[:, near], along[:, near], direction[near]
        away = centre - robot_m[:, None]
        distance = np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-6)
        centre = centre + away / distance * np.maximum(PERSONAL_M - distance, 0.0)
        side = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
        swing = 0.5 * STRIDE_M * np.sin(np.pi * along / STRIDE_M)
        swing = np.where((along <= 0.0) | (along >= length[near]), 0.0, swing)[..., None]
        leg = LEG_DISTANCE_M * side + swing * direction
        legs = np.concatenate([centre + leg, centre - leg], axis=1)
        return np.concatenate([legs, np.full((*legs.shape[:2], 1), LEG_RADIUS_M)], axis=-1)
