"""A spinning 2D lidar: each beam starts from the robot's pose at the time of that beam.

`time_s` is always the time in seconds since the start of the lap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from beamsplat.tools.simulator.mesh import SceneMesh
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.settings import LidarSettings

TIME_SLICES = 10  # parts of a revolution; within each, dynamic objects are treated as static
GRAZING_COSINE = 0.08  # cosine of incidence below which half of the beams have no return

PoseAt = Callable[[np.ndarray], np.ndarray]  # times [N] in seconds -> pose_world_body (x, y, yaw) [N, 3]


class DynamicScene(Protocol):
    """The objects that move while the lidar turns."""

    def bounding_circles(self, time_s: float) -> np.ndarray:
        """Return float64 [A, 3]: x, y and radius in metres of a circle around each of A objects."""

    def ray_caster_of(self, index: int, time_s: float) -> RayCaster:
        """Return a ray caster of object number `index`, posed at `time_s`."""


@dataclass(frozen=True)
class SimulatedRevolution:
    """Noise-free ranges of the B beams of one revolution, in the order in which they are measured."""

    range_m: np.ndarray  # float64 [B], +inf = no surface
    moving: np.ndarray  # bool [B], the beam hits a dynamic object
    behind_m: np.ndarray  # float64 [B], range of the surface behind the glass that was hit; NaN = no glass
    cosine: np.ndarray  # float32 [B], cosine of the angle of incidence


class SimulatedLidar:
    """A lidar in one static scene; computes the ranges of its revolutions by ray casting."""

    def __init__(self, mesh: SceneMesh, caster: RayCaster, settings: LidarSettings) -> None:
        self.settings = settings
        self._caster = caster
        glass = np.array([m.glass for m in mesh.materials])[mesh.material]
        self._glass = glass
        self._caster_without_glass = (
            RayCaster(mesh.vertices_m, mesh.triangles[~glass]) if glass.any() else None
        )
        n = caster._normal
        self._unit = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-30)
        s = settings
        self._angle = s.yaw_rad + s.angle_min_rad + s.angle_increment_rad * np.arange(s.beams)

    def revolution(
        self, time_s: float, pose_at: PoseAt, dynamic_scene: DynamicScene | None = None
    ) -> SimulatedRevolution:
        """Return the noise-free ranges of the revolution whose first beam is at `time_s`.

        `pose_at` returns the true pose of the robot at the time of each beam.
        """
        s = self.settings
        times = time_s + s.time_increment_s * np.arange(s.beams)
        pose = pose_at(times)
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        origins = np.stack(
            [
                pose[:, 0] + cos * s.x_m - sin * s.y_m,
                pose[:, 1] + sin * s.x_m + cos * s.y_m,
                np.full(s.beams, s.z_m),
            ],
            axis=1,
        )
        heading = pose[:, 2] + self._angle
        rays = np.stack([np.cos(heading), np.sin(heading), np.zeros(s.beams)], axis=1)
        hit = self._caster.first_hit(origins, rays)
        distance = self._caster.hit_distance(origins, rays, hit)
        cosine = np.where(hit >= 0, np.abs(np.einsum("ij,ij->i", self._unit[hit], rays)), 1.0)
        behind = np.full(s.beams, np.nan)
        at = np.flatnonzero((hit >= 0) & self._glass[hit])
        if len(at) and self._caster_without_glass is not None:
            second = self._caster_without_glass.first_hit(origins[at], rays[at])
            behind[at] = self._caster_without_glass.hit_distance(origins[at], rays[at], second)
        moving = np.zeros(s.beams, np.bool_)
        if dynamic_scene is not None:
            for beams in np.array_split(np.arange(s.beams), TIME_SLICES):
                self._cast_at_dynamic_objects(
                    dynamic_scene, float(times[beams].mean()), beams, origins, rays, distance, moving
                )
            behind[moving] = np.nan
        return SimulatedRevolution(distance, moving, behind, cosine.astype(np.float32))

    @staticmethod
    def _cast_at_dynamic_objects(
        dynamic_scene: DynamicScene,
        time_s: float,
        beams: np.ndarray,
        origins: np.ndarray,
        rays: np.ndarray,
        distance: np.ndarray,
        moving: np.ndarray,
    ) -> None:
        """Reduce `distance` of each beam that hits a dynamic object, and set its `moving`, both in place.

        `beams` contains the indices of the beams to test. A ray is cast only for beams that pass through the
        bounding circle of an object.
        """
        for index, (x, y, radius) in enumerate(dynamic_scene.bounding_circles(time_s)):
            to = np.array([x, y]) - origins[beams, :2]
            along = np.einsum("ij,ij->i", to, rays[beams, :2])
            aside = np.abs(to[:, 0] * rays[beams, 1] - to[:, 1] * rays[beams, 0])
            at = beams[(aside < radius) & (along > -radius) & (along - radius < distance[beams])]
            if len(at) == 0:
                continue
            caster = dynamic_scene.ray_caster_of(index, time_s)
            nearer = caster.hit_distance(origins[at], rays[at], caster.first_hit(origins[at], rays[at]))
            won = at[nearer < distance[at]]
            distance[won], moving[won] = nearer[nearer < distance[at]], True

    def measure(
        self, revolution: SimulatedRevolution, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Add noise, dropouts and random passage through glass to the ranges of a revolution.

        The number of random draws does not depend on the ranges, so one scan never changes the noise of the
        next scan.

        Returns:
            The measured ranges float32 [B] in metres (+inf = no return), and bool [B]: whether each beam
            passed through glass.
        """
        s = self.settings
        noise, lost, grazed, passed = rng.standard_normal(s.beams), *rng.random((3, s.beams))
        range_m = revolution.range_m
        through = np.isfinite(revolution.behind_m) | np.isinf(revolution.behind_m)
        through &= s.glass & (passed < s.glass_pass)
        range_m = np.where(through, revolution.behind_m, range_m)
        range_m = range_m + s.noise_m * noise
        lost_return = lost < s.dropout
        if s.dropout > 0:
            lost_return |= (revolution.cosine < GRAZING_COSINE) & (grazed < 0.5)
        lost_return |= ~((range_m >= s.range_min_m) & (range_m <= s.range_max_m))
        measured = np.where(lost_return, np.inf, range_m).astype(np.float32)
        see_robot(measured, s, noise)
        return measured, through


def see_robot(ranges_m: np.ndarray, settings: LidarSettings, noise: np.ndarray) -> None:
    """Set, in place, the ranges float32 [B] of the beams that hit the robot itself.

    `noise` float64 [B]: standard normal.
    """
    if settings.self_returns is not None:
        first, count, range_m = settings.self_returns
        seen = slice(first, first + count)
        ranges_m[seen] = range_m + settings.noise_m * noise[seen]
