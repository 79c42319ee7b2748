"""One picture of a lit scene: primary rays, shading, and four more rays where an edge crosses a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.tools.simulator.cast import Caster
from beamsplat.tools.simulator.shade import Surfaces, find_edges, mark_cones, shade, turn_rays

SUBPIXELS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
NO_BALLS = np.zeros((0, 4))
FAR_M = np.float32(1e6)


@dataclass(frozen=True)
class Actors:
    """Moving things at one instant, with what they do to the light around them."""

    caster: Caster
    surfaces: Surfaces
    bounds: np.ndarray  # float64 [A, 4] centre and radius of a ball round each
    balls: np.ndarray  # float64 [K, 4] contact shadows


@dataclass(frozen=True)
class Picture:
    """What the camera's place sees, before the sensor."""

    radiance: np.ndarray  # float32 [H, W, 3] linear
    depth_z_m: np.ndarray  # float32 [H, W], NaN = nothing
    moving: np.ndarray  # bool [H, W], the pixel's centre shows an actor
    triangle: np.ndarray  # int32 [H, W] of the static scene, -1 = nothing


@dataclass(frozen=True)
class RayTable:
    """Rays of all pixels in the camera frame with z = 1, and how they change from pixel to pixel."""

    rays: np.ndarray  # float32 [H, W, 3]
    rays_x: np.ndarray
    rays_y: np.ndarray


def ray_table(rays: np.ndarray) -> RayTable:
    """From rays float64 [H, W, 3]."""
    dx, dy = np.gradient(rays, axis=1), np.gradient(rays, axis=0)
    return RayTable(rays.astype(np.float32), dx.astype(np.float32), dy.astype(np.float32))


class Renderer:
    """Draws one static scene, with or without actors."""

    def __init__(self, caster: Caster, scene: Surfaces) -> None:
        self.caster = caster
        self.scene = scene
        self._surface = np.append(scene.surface, np.int32(-1))  # [-1]: nothing

    def picture(self, T_world_camera: np.ndarray, table: RayTable, actors: Actors | None = None) -> Picture:
        """The view from T_world_camera [4, 4]."""
        height, width = table.rays.shape[:2]
        R = np.ascontiguousarray(T_world_camera[:3, :3], dtype=np.float32)
        origin = T_world_camera[:3, 3].astype(np.float64)
        rays, rays_x, rays_y = (_turned(a, R) for a in (table.rays, table.rays_x, table.rays_y))
        colour = np.zeros((len(rays), 3), np.float32)
        depth = np.full(len(rays), FAR_M)
        triangle, moving, surface = self._trace(origin, rays, rays_x, rays_y, 1.0, actors, colour, depth)
        edge = np.zeros((height, width), np.bool_)
        find_edges(surface.reshape(height, width), depth.reshape(height, width), edge)
        at = np.flatnonzero(edge.ravel())
        if len(at):
            colour[at] = self._supersampled(origin, rays[at], rays_x[at], rays_y[at], actors)
        depth_z = np.where(depth < FAR_M, depth, np.float32(np.nan))
        return Picture(
            colour.reshape(height, width, 3),
            depth_z.reshape(height, width),
            moving.reshape(height, width),
            triangle.reshape(height, width),
        )

    def _supersampled(
        self,
        origin: np.ndarray,
        rays: np.ndarray,
        rays_x: np.ndarray,
        rays_y: np.ndarray,
        actors: Actors | None,
    ) -> np.ndarray:
        jittered = np.concatenate([rays + x * rays_x + y * rays_y for x, y in SUBPIXELS])
        dx, dy = np.tile(rays_x, (len(SUBPIXELS), 1)), np.tile(rays_y, (len(SUBPIXELS), 1))
        colour = np.zeros((len(jittered), 3), np.float32)
        depth = np.full(len(jittered), FAR_M)
        self._trace(origin, jittered, dx, dy, 0.6, actors, colour, depth)
        # Bright glass beside a dark frame must not swamp the pixel: average what the sensor can hold.
        return np.minimum(colour, 1.5).reshape(len(SUBPIXELS), -1, 3).mean(axis=0)

    def _trace(
        self,
        origin: np.ndarray,
        rays: np.ndarray,
        rays_x: np.ndarray,
        rays_y: np.ndarray,
        scale: float,
        actors: Actors | None,
        colour: np.ndarray,
        depth: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        balls = NO_BALLS if actors is None else actors.balls
        triangle = self.caster.first_from(origin, rays)
        shade(self.scene, triangle, origin, rays, rays_x, rays_y, scale, balls, colour, depth)
        surface = self._surface[triangle]
        moving = np.zeros(len(rays), np.bool_)
        if actors is None:
            return triangle, moving, surface
        at = _near(origin, rays, actors.bounds)
        if len(at) == 0:
            return triangle, moving, surface
        hit = actors.caster.first_from(origin, rays[at])
        before, part = depth[at], colour[at]
        after = before.copy()
        shade(actors.surfaces, hit, origin, rays[at], rays_x[at], rays_y[at], scale, NO_BALLS, part, after)
        moving[at] = after < before
        colour[at], depth[at] = part, after
        surface[at] = np.where(after < before, -2 - actors.surfaces.surface[hit], surface[at])
        return triangle, moving, surface


def _turned(table: np.ndarray, R: np.ndarray) -> np.ndarray:
    out = np.empty((table.shape[0] * table.shape[1], 3), np.float32)
    turn_rays(table.reshape(-1, 3), R, out)
    return out


def _near(origin: np.ndarray, rays: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Indices of rays that may meet one of the balls."""
    to = bounds[:, :3] - origin
    distance = np.linalg.norm(to, axis=1)
    if np.any(distance <= bounds[:, 3]):
        return np.arange(len(rays))
    cos_limit = np.sqrt(1.0 - (bounds[:, 3] / distance) ** 2)
    near = np.zeros(len(rays), np.bool_)
    mark_cones(rays, to / distance[:, None], cos_limit, near)
    return np.flatnonzero(near)
