"""A spinning 2D lidar: each beam from where the robot is at the beam's own time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from beamsplat.tools.simulator.cast import Caster
from beamsplat.tools.simulator.mesh import Mesh
from beamsplat.tools.simulator.settings import LidarSettings

SLICES = 10  # of a revolution, in each of which movers stand still
GRAZING = 0.08  # cosine below which a beam often does not come back

PoseAt = Callable[[np.ndarray], np.ndarray]  # seconds [N] -> SE(2) poses [N, 3]


class Movers(Protocol):
    """What moves while the lidar turns."""

    def circles(self, time_s: float) -> np.ndarray:
        """float64 [A, 3]: x, y and a radius that each mover stays within."""

    def caster_of(self, index: int, time_s: float) -> Caster:
        """One mover as it stands at a time."""


@dataclass(frozen=True)
class Revolution:
    """What the beams of one revolution meet, without noise."""

    range_m: np.ndarray  # float64 [B], +inf nothing
    moving: np.ndarray  # bool [B], the beam meets something that moves
    behind_m: np.ndarray  # float64 [B], range if the glass in the way lets the beam pass; NaN: no glass
    cosine: np.ndarray  # float32 [B] of incidence


class Lidar:
    """Casts revolutions in one scene."""

    def __init__(self, mesh: Mesh, caster: Caster, settings: LidarSettings) -> None:
        self.settings = settings
        self._caster = caster
        glass = np.array([m.glass for m in mesh.materials])[mesh.material]
        self._glass = glass
        self._open = Caster(mesh.vertices_m, mesh.triangles[~glass]) if glass.any() else None
        n = caster._normal
        self._unit = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-30)
        s = settings
        self._angle = s.angle_min_rad + s.angle_increment_rad * np.arange(s.beams)

    def revolution(self, time_s: float, pose_at: PoseAt, movers: Movers | None = None) -> Revolution:
        """The revolution that starts at a time."""
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
        hit = self._caster.first(origins, rays)
        distance = self._caster.distance(origins, rays, hit)
        cosine = np.where(hit >= 0, np.abs(np.einsum("ij,ij->i", self._unit[hit], rays)), 1.0)
        behind = np.full(s.beams, np.nan)
        at = np.flatnonzero((hit >= 0) & self._glass[hit])
        if len(at) and self._open is not None:
            second = self._open.first(origins[at], rays[at])
            behind[at] = self._open.distance(origins[at], rays[at], second)
        moving = np.zeros(s.beams, np.bool_)
        if movers is not None:
            for part in np.array_split(np.arange(s.beams), SLICES):
                self._meet(movers, float(times[part].mean()), part, origins, rays, distance, moving)
            behind[moving] = np.nan
        return Revolution(distance, moving, behind, cosine.astype(np.float32))

    @staticmethod
    def _meet(
        movers: Movers,
        time_s: float,
        part: np.ndarray,
        origins: np.ndarray,
        rays: np.ndarray,
        distance: np.ndarray,
        moving: np.ndarray,
    ) -> None:
        """Shortens the beams `part` that meet a mover at a time; only those that pass near one are cast."""
        for index, (x, y, radius) in enumerate(movers.circles(time_s)):
            to = np.array([x, y]) - origins[part, :2]
            along = np.einsum("ij,ij->i", to, rays[part, :2])
            aside = np.abs(to[:, 0] * rays[part, 1] - to[:, 1] * rays[part, 0])
            at = part[(aside < radius) & (along > -radius) & (along - radius < distance[part])]
            if len(at) == 0:
                continue
            caster = movers.caster_of(index, time_s)
            nearer = caster.distance(origins[at], rays[at], caster.first(origins[at], rays[at]))
            won = at[nearer < distance[at]]
            distance[won], moving[won] = nearer[nearer < distance[at]], True

    def measure(self, revolution: Revolution, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Ranges float32 [B] as the device reports them (+inf no return), and bool [B]: went through glass.

        The same number of random draws is made whatever is seen: one scan never changes the next one's noise.
        """
        s = self.settings
        noise, lost, grazed, passed = rng.standard_normal(s.beams), *rng.random((3, s.beams))
        range_m = revolution.range_m
        through = np.isfinite(revolution.behind_m) | np.isinf(revolution.behind_m)
        through &= s.glass & (passed < s.glass_pass)
        range_m = np.where(through, revolution.behind_m, range_m)
        range_m = range_m + s.noise_m * noise
        gone = lost < s.dropout
        if s.dropout > 0:
            gone |= (revolution.cosine < GRAZING) & (grazed < 0.5)
        gone |= ~((range_m >= s.range_min_m) & (range_m <= s.range_max_m))
        return np.where(gone, np.inf, range_m).astype(np.float32), through
