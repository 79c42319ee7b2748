"""Motions of the sensors through a training home: on a robot, and in a hand near surfaces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import inverse, make_transform, so3_exp
from beamsplat.tools.simulator.camera import pixel_rays
from beamsplat.tools.simulator.path import DrivePath
from beamsplat.tools.simulator.render import SceneRenderer, ray_table

TIME_STEP_S = 0.02  # of the search for the times of images
_KNOT_S = 1.2  # time between the knots of a hand's motion
_HAND_XYZ_M = (0.22, 0.22, 0.14)  # standard deviation of a hand's position about its anchor
_HAND_RPY_RAD = (0.08, 0.13, 0.30)
_NEAR_M = (0.35, 1.1)  # distance of the nearest surfaces at an anchor
SMALL_K = np.array([[60.0, 0.0, 35.5], [0.0, 60.0, 26.5], [0.0, 0.0, 1.0]])  # of views that measure distance
SMALL_VIEW = ray_table(pixel_rays(72, 54, SMALL_K))


class Motion(Protocol):
    """Pose of the sensors' body as a function of time."""

    @property
    def duration_s(self) -> float:
        """Length of the motion, s."""
        ...

    @property
    def start_s(self) -> float:
        """Time on the clock of the moving objects at which the motion starts, s."""
        ...

    def pose_at(self, time_s: float) -> np.ndarray:
        """Return `T_world_body` float64 [4, 4] at a time in [0, duration_s]."""
        ...


@dataclass(frozen=True)
class RobotMotion:
    """A lap of the robot, from a time on it."""

    drive: DrivePath
    start_s: float

    @property
    def duration_s(self) -> float:
        return self.drive.lap_s

    def pose_at(self, time_s: float) -> np.ndarray:
        """Return `T_world_body`, level on the floor."""
        return self.drive.transform_at((self.start_s + time_s) % self.drive.lap_s)


class HandMotion:
    """Smooth random motion of a hand-held body about an anchor pose; the body is the level camera frame."""

    def __init__(
        self, T_world_anchor: np.ndarray, duration_s: float, start_s: float, rng: np.random.Generator
    ) -> None:
        self.duration_s, self.start_s = duration_s, start_s
        self._T_world_anchor = T_world_anchor
        knots = np.arange(-_KNOT_S, duration_s + 2.0 * _KNOT_S, _KNOT_S)
        size = np.array([*_HAND_XYZ_M, *_HAND_RPY_RAD])
        self._spline = CubicSpline(knots, rng.standard_normal((len(knots), 6)) * size)

    def pose_at(self, time_s: float) -> np.ndarray:
        """Return `T_world_body`."""
        x, y, z, roll, pitch, yaw = self._spline(time_s)
        R = so3_exp([0.0, 0.0, yaw]) @ so3_exp([0.0, pitch, 0.0]) @ so3_exp([roll, 0.0, 0.0])
        return self._T_world_anchor @ make_transform(R, np.array([x, y, z]))


def hand_motion(
    drive: DrivePath, renderer: SceneRenderer, duration_s: float, rng: np.random.Generator
) -> HandMotion:
    """Return a hand's motion about a random place on the robot's path, in front of near surfaces."""
    start_s = float(rng.uniform(0.0, drive.lap_s))
    R = so3_exp([0.0, 0.0, rng.uniform(-np.pi, np.pi)]) @ so3_exp([0.0, rng.uniform(0.0, 0.55), 0.0])
    T = drive.transform_at(start_s) @ make_transform(R, np.array([0.0, 0.0, rng.uniform(0.8, 1.7)]))
    view = renderer.render(T @ camera_mount(0.0, 0.0, 0.0), SMALL_VIEW)
    known = view.depth_z_m[np.isfinite(view.depth_z_m)]
    if len(known):
        ahead = float(np.percentile(known, 8)) - rng.uniform(*_NEAR_M)
        T[:3, 3] += T[:3, 0] * np.clip(ahead, -0.3, 3.0)
    return HandMotion(T, duration_s, start_s, rng)


def image_times(
    motion: Motion, step_m: float, step_rad: float, most: int, rng: np.random.Generator
) -> Iterator[float]:
    """Yield times at which the body has moved by about `step_m` or turned by `step_rad` since the last one.

    At most `most` times are yielded.
    """
    last: np.ndarray | None = None
    step = step_m
    for time_s in np.arange(0.0, motion.duration_s, TIME_STEP_S):
        T = motion.pose_at(float(time_s))
        if last is not None:
            relative = inverse(last) @ T
            turn = np.arccos(np.clip((np.trace(relative[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
            if np.linalg.norm(relative[:3, 3]) < step and turn < step_rad:
                continue
        if most == 0:
            return
        most, last, step = most - 1, T, step_m * rng.uniform(0.85, 1.15)
        yield float(time_s)
