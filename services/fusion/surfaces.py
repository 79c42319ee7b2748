"""Candidate surfaces: surfaces that lidar, lidar map and floor predict in an image, used as priors."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.beams import Beams, azimuth_and_range, occluded_beams, plane_depth, wall_ranges
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import yaw_of
from beamsplat.services.fusion.lidar_map import LidarMap
from beamsplat.services.fusion.wall_lines import find_lines, ranges_to_lines

_COARSE_AZIMUTHS_PER_PX, _FINE_AZIMUTHS_PER_PX = 2, 8
_CONTINUED = 3  # extrapolated walls per ray
_POST_HEIGHT_M = 0.35  # assumed extent of legs and posts above and below the lidar plane


@dataclass(frozen=True)
class CandidateSurfaces:
    """Optical z (m) [h, w] of each candidate surface; NaN where the pixel's ray does not meet the surface."""

    wall: np.ndarray  # nearest beam of the column, extruded vertically
    background_wall: np.ndarray  # the same without narrow objects (legs, posts)
    wall_offset_m: np.ndarray  # how far above or below the lidar plane the pixel meets that wall
    floor: np.ndarray
    occluded_walls: tuple[np.ndarray, ...]  # walls behind it, from the lidar map
    ceilings: tuple[np.ndarray, ...]

    @property
    def nearest(self) -> np.ndarray:
        """Return the smallest depth [h, w] of wall, floor and ceilings."""
        with np.errstate(invalid="ignore"):
            high = self.wall_offset_m > _POST_HEIGHT_M
        near = np.fmin(np.where(high, self.background_wall, self.wall), self.floor)
        for ceiling in self.ceilings:
            near = np.fmin(near, ceiling)
        return near

    @property
    def on_floor(self) -> np.ndarray:
        """Return bool [h, w]: True where the floor is nearer than the wall."""
        with np.errstate(invalid="ignore"):
            return np.isfinite(self.floor) & ~(self.wall < self.floor)


def snap(depth: np.ndarray, surfaces: CandidateSurfaces, tolerance: float, wall_reach_m: float) -> np.ndarray:
    """Set depth [h, w] (m), in place, to the nearest candidate surface; return bool [h, w]: where set.

    A surface is accepted if it differs by less than `tolerance` in log depth; extruded walls only up to
    `wall_reach_m` above and below the lidar plane.
    """
    wall = np.where(surfaces.on_floor | ~(surfaces.wall_offset_m < wall_reach_m), np.nan, surfaces.wall)
    best = np.full(depth.shape, tolerance)
    result = depth.copy()
    background_wall = (
        np.where(surfaces.on_floor, np.nan, surfaces.background_wall) if np.isinf(wall_reach_m) else wall
    )
    for surface in (wall, background_wall, surfaces.floor, *surfaces.occluded_walls, *surfaces.ceilings):
        with np.errstate(invalid="ignore"):
            error = np.abs(np.log(surface / depth))
            nearer = error < best
        result[nearer] = surface[nearer]
        best = np.where(nearer, error, best)
    depth[:] = result
    return best < tolerance


class SurfacePredictor:
    """Predicts candidate surfaces: intersects the rays of one camera with beams, map, floor, ceilings."""

    def __init__(self, camera: Pinhole, T_body_camera: np.ndarray, *, floor_known: bool) -> None:
        self._T_body_camera = T_body_camera
        self._floor_known = floor_known
        self.rays_body = camera.ray_grid() @ T_body_camera[:3, :3].T
        self._azimuth = np.arctan2(self.rays_body[..., 1], self.rays_body[..., 0])
        self._ray_xy = np.maximum(np.hypot(self.rays_body[..., 0], self.rays_body[..., 1]), 1e-9)
        self.ray_z = np.ascontiguousarray(self.rays_body[..., 2])
        self.camera_z_m = float(T_body_camera[2, 3])
        empty = np.full(self.ray_z.shape, np.nan)
        self.floor = plane_depth(self.rays_body, self.camera_z_m) if floor_known else empty
        self._coarse_azimuths, self._coarse_index = self._azimuth_grid(
            _COARSE_AZIMUTHS_PER_PX * camera.width_px
        )
        self._fine_azimuths, self._fine_index = self._azimuth_grid(_FINE_AZIMUTHS_PER_PX * camera.width_px)

    def _azimuth_grid(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return `count` azimuths (rad) over the view, and int64 [h, w]: index of each pixel's nearest."""
        low, high = float(self._azimuth.min()), float(self._azimuth.max())
        place = (self._azimuth - low) / max(high - low, 1e-9) * (count - 1)
        index = np.clip(np.rint(place).astype(np.int64), 0, count - 1)
        return np.linspace(low, high, count), index

    def _extrude(self, azimuth: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return optical z [h, w] (m) of vertically extruded beams, sampled finer than the pixels."""
        return wall_ranges(self._fine_azimuths, azimuth, reach)[self._fine_index] / self._ray_xy

    def _occluded(self, ranges: np.ndarray, wall: np.ndarray) -> list[np.ndarray]:
        """Return, per layer of `ranges` [L, M], the optical z [h, w] of walls hidden behind `wall`."""
        layers = []
        for layer in ranges[:, self._coarse_index] / self._ray_xy:
            with np.errstate(invalid="ignore"):
                farther = (layer > 1.08 * wall) & ~(self.floor < layer)
            if farther.any():
                layers.append(np.where(farther, layer, np.nan))
        return layers

    def find(
        self,
        beams: Beams,
        lidar_map: LidarMap | None,
        T_map_body: np.ndarray,
        ceiling_heights_m: tuple[float, ...],
    ) -> CandidateSurfaces:
        """Return the candidate surfaces of one view; `ceiling_heights_m` are heights above the floor."""
        points = beams.points_body_m
        points = points[~occluded_beams(points, self._T_body_camera)]
        azimuth, reach = azimuth_and_range(points, self._T_body_camera)
        wall = self._extrude(azimuth, reach)
        lidar_z_m = float(np.median(points[:, 2])) if len(points) else 0.0
        wall_offset = np.abs(self.camera_z_m + wall * self.ray_z - lidar_z_m)
        background_wall = self._extrude(azimuth, remove_narrow_objects(azimuth, reach))
        occluded_walls: list[np.ndarray] = []
        if lidar_map is not None:
            position = (T_map_body @ self._T_body_camera)[:2, 3]
            ranges = lidar_map.layers(position, self._coarse_azimuths + float(yaw_of(T_map_body)))
            occluded_walls += self._occluded(ranges, wall)
            lines = find_lines(lidar_map.points(), lidar_map.cell_m)
            front = wall_ranges(self._coarse_azimuths, azimuth, reach)
            beyond = np.maximum(np.nan_to_num(front, nan=np.inf) * 1.08, front + 0.15)
            hit_ranges = ranges_to_lines(
                lines, position, self._coarse_azimuths + float(yaw_of(T_map_body)), beyond, _CONTINUED
            )
            occluded_walls += self._occluded(hit_ranges, wall)
        ceilings = []
        for height in ceiling_heights_m:
            plane = plane_depth(self.rays_body, self.camera_z_m, height)
            with np.errstate(invalid="ignore"):
                ceilings.append(np.where((self.ray_z > 0.02) & (plane < background_wall), plane, np.nan))
        return CandidateSurfaces(
            wall, background_wall, wall_offset, self.floor, tuple(occluded_walls), tuple(ceilings)
        )


def remove_narrow_objects(
    azimuth_rad: np.ndarray, reach_m: np.ndarray, width_m: float = 0.3, jump: float = 1.15
) -> np.ndarray:
    """Return ranges [N] (m) in which narrow objects are replaced by the surface beside them.

    A group of beams not wider than `width_m`, whose neighbours on both sides are farther by the factor
    `jump`, is taken as a leg or a post. Such objects seldom reach the ceiling.
    """
    order = np.argsort(azimuth_rad, kind="stable")
    a, r = azimuth_rad[order], reach_m[order].copy()
    for _ in range(2):  # two passes: a post in front of a post
        cut = np.flatnonzero(np.maximum(r[1:], r[:-1]) > jump * np.minimum(r[1:], r[:-1])) + 1
        starts, stops = np.concatenate([[0], cut]), np.concatenate([cut, [len(r)]])
        out = r.copy()
        for first, stop in zip(starts, stops):
            if first == 0 or stop == len(r):
                continue
            middle = float(np.median(r[first:stop]))
            left, right = r[first - 1], r[stop]
            narrow = (a[stop - 1] - a[first]) * middle < width_m
            if narrow and min(left, right) > jump * middle:
                share = np.linspace(0.0, 1.0, stop - first + 2)[1:-1]
                out[first:stop] = 1.0 / ((1.0 - share) / left + share / right)
        r = out
    result = np.empty_like(r)
    result[order] = r
    return result


class CeilingDetector:
    """Detector of ceilings (horizontal planes above the camera) from the matching costs of keyframes.

    The evidence decays by 10 % per keyframe, because the next room may have a ceiling at another height.
    """

    def __init__(self, low_m: float = 1.6, high_m: float = 4.5, step_m: float = 0.05) -> None:
        self.heights_m = np.arange(low_m, high_m, step_m)
        self._evidence = np.zeros(len(self.heights_m))
        self._apart = round(0.2 / step_m)

    def copy(self) -> CeilingDetector:
        """Return a detector with the same evidence, which changes independently."""
        return copy.copy(self)  # `add` replaces the evidence, and nothing else changes

    def add(self, gain: np.ndarray) -> None:
        """Add the evidence [n] of one keyframe (`volume_kernels.plane_gain`), one value per height."""
        self._evidence = 0.9 * self._evidence + gain

    def heights(self, least: float, most: int = 2) -> tuple[float, ...]:
        """Return the heights (m) of up to `most` peaks of the evidence above `least`, strongest first."""
        e = self._evidence
        peaks = [k for k in range(1, len(e) - 1) if e[k] > least and e[k] > e[k - 1] and e[k] >= e[k + 1]]
        found: list[int] = []
        for k in sorted(peaks, key=lambda k: -e[k]):
            if len(found) < most and all(abs(k - other) > self._apart for other in found):
                found.append(k)
        step_m = self.heights_m[1] - self.heights_m[0]
        bend = [e[k - 1] - 2.0 * e[k] + e[k + 1] for k in found]
        tops = [0.5 * (e[k - 1] - e[k + 1]) / b if b < 0.0 else 0.0 for k, b in zip(found, bend)]
        return tuple(float(self.heights_m[k] + step_m * top) for k, top in zip(found, tops))
