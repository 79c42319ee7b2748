"""Ray-traced views of a lit scene: one ray per pixel, shading, and four rays per pixel at edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.shade import ShadingTables, find_edges, mark_cones, rotate_rays, shade

# Offsets of the four samples of a pixel on an edge, in pixels: a rotated grid.
SUBPIXELS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
NO_SPHERES = np.zeros((0, 4))
FAR_M = np.float32(1e6)  # depth of pixels without a surface, while rendering


@dataclass(frozen=True)
class ActorSnapshot:
    """Geometry, light and bounding spheres of A dynamic objects at one instant, in the world frame."""

    caster: RayCaster
    surfaces: ShadingTables
    bounding_spheres: np.ndarray  # float64 [A, 4], centre and radius in metres of a sphere around each object
    occluder_spheres: np.ndarray  # float64 [K, 4], centre and radius in m of spheres with contact shadows


@dataclass(frozen=True)
class RenderedView:
    """A rendered view, before the image sensor: radiance, depth, and the object in each pixel."""

    radiance: np.ndarray  # float32 [H, W, 3], linear RGB
    depth_z_m: np.ndarray  # float32 [H, W], depth along the optical axis, NaN = no surface
    moving: np.ndarray  # bool [H, W], the pixel's centre shows a dynamic object
    triangle: np.ndarray  # int32 [H, W], index of the triangle of the static scene, -1 = none


@dataclass(frozen=True)
class RayTable:
    """Rays of all pixels in the camera frame with z = 1, and their change per pixel in image x and y."""

    rays: np.ndarray  # float32 [H, W, 3]
    rays_x: np.ndarray  # float32 [H, W, 3]
    rays_y: np.ndarray  # float32 [H, W, 3]


def ray_table(rays: np.ndarray) -> RayTable:
    """Return the ray table of the pixel rays float64 [H, W, 3], in the camera frame with z = 1."""
    dx, dy = np.gradient(rays, axis=1), np.gradient(rays, axis=0)
    return RayTable(rays.astype(np.float32), dx.astype(np.float32), dy.astype(np.float32))


class SceneRenderer:
    """Renders one static scene, with or without dynamic objects."""

    def __init__(self, caster: RayCaster, scene: ShadingTables) -> None:
        self.caster = caster
        self.scene = scene
        self._surface = np.append(scene.surface, np.int32(-1))  # index -1: no surface

    def render(
        self, T_world_camera: np.ndarray, table: RayTable, actors: ActorSnapshot | None = None
    ) -> RenderedView:
        """Return the view from the pose T_world_camera float64 [4, 4] through the rays of `table`."""
        height, width = table.rays.shape[:2]
        R = np.ascontiguousarray(T_world_camera[:3, :3], dtype=np.float32)
        origin = T_world_camera[:3, 3].astype(np.float64)
        rays, rays_x, rays_y = (_rotated(a, R) for a in (table.rays, table.rays_x, table.rays_y))
        colour = np.zeros((len(rays), 3), np.float32)
        depth = np.full(len(rays), FAR_M)
        triangle, moving, surface = self._trace(origin, rays, rays_x, rays_y, 1.0, actors, colour, depth)
        edge = np.zeros((height, width), np.bool_)
        find_edges(surface.reshape(height, width), depth.reshape(height, width), edge)
        at = np.flatnonzero(edge.ravel())
        if len(at):
            colour[at] = self._supersampled(origin, rays[at], rays_x[at], rays_y[at], actors)
        depth_z = np.where(depth < FAR_M, depth, np.float32(np.nan))
        return RenderedView(
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
        actors: ActorSnapshot | None,
    ) -> np.ndarray:
        jittered = np.concatenate([rays + x * rays_x + y * rays_y for x, y in SUBPIXELS])
        dx, dy = np.tile(rays_x, (len(SUBPIXELS), 1)), np.tile(rays_y, (len(SUBPIXELS), 1))
        colour = np.zeros((len(jittered), 3), np.float32)
        depth = np.full(len(jittered), FAR_M)
        self._trace(origin, jittered, dx, dy, 0.6, actors, colour, depth)
        # Clip before averaging, so that a bright window beside a dark frame does not dominate the pixel.
        return np.minimum(colour, 1.5).reshape(len(SUBPIXELS), -1, 3).mean(axis=0)

    def _trace(
        self,
        origin: np.ndarray,
        rays: np.ndarray,
        rays_x: np.ndarray,
        rays_y: np.ndarray,
        scale: float,
        actors: ActorSnapshot | None,
        colour: np.ndarray,
        depth: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        occluder_spheres = NO_SPHERES if actors is None else actors.occluder_spheres
        triangle = self.caster.first_hit_from(origin, rays)
        shade(self.scene, triangle, origin, rays, rays_x, rays_y, scale, occluder_spheres, colour, depth)
        surface = self._surface[triangle]
        moving = np.zeros(len(rays), np.bool_)
        if actors is None:
            return triangle, moving, surface
        at = _rays_near_actors(origin, rays, actors.bounding_spheres)
        if len(at) == 0:
            return triangle, moving, surface
        hit = actors.caster.first_hit_from(origin, rays[at])
        before, part = depth[at], colour[at]
        after = before.copy()
        shade(actors.surfaces, hit, origin, rays[at], rays_x[at], rays_y[at], scale, NO_SPHERES, part, after)
        moving[at] = after < before
        colour[at], depth[at] = part, after
        surface[at] = np.where(after < before, -2 - actors.surfaces.surface[hit], surface[at])
        return triangle, moving, surface


def _rotated(table: np.ndarray, R: np.ndarray) -> np.ndarray:
    out = np.empty((table.shape[0] * table.shape[1], 3), np.float32)
    rotate_rays(table.reshape(-1, 3), R, out)
    return out


def _rays_near_actors(origin: np.ndarray, rays: np.ndarray, bounding_spheres: np.ndarray) -> np.ndarray:
    """Return the indices of the rays from `origin` that may hit one of the bounding spheres [A, 4]."""
    to = bounding_spheres[:, :3] - origin
    distance = np.linalg.norm(to, axis=1)
    if np.any(distance <= bounding_spheres[:, 3]):
        return np.arange(len(rays))
    cos_limit = np.sqrt(1.0 - (bounding_spheres[:, 3] / distance) ** 2)
    near = np.zeros(len(rays), np.bool_)
    mark_cones(rays, to / distance[:, None], cos_limit, near)
    return np.flatnonzero(near)
